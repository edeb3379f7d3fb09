"""The network of Deformable-3D-Gaussians, rebuilt from its weights: where a Gaussian is at a time.

With e(x) = (x, sin 2^k x, cos 2^k x) for k = 0, 1, ..., position and time go encoded through layers with ReLU; the
layer after the middle one sees them a second time. Three linear heads then tell the offset of the centre, of the
quaternion and of the scales. In a variant for synthetic scenes two layers encode time first; in another the head of the
centre is a screw motion. Widths, depth and variant follow from the names and shapes of the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from d2_plugin.errors import D2Error

TIME_FREQUENCIES = 10
"""Of the variant that does not encode time by layers, which alone says it by their widths."""
AXIS_SHIFT = 1e-5
"""Added to the entries of a screw axis by the repository, after the division by its length."""


class MotionNetwork:
    """`deform.pth`: an object with the two names that the adapter `deformable3d` uses, `step` and `deform`."""

    def __init__(self, state: Mapping[str, Tensor], path: Path) -> None:
        """Take the weights.

        Raises:
            D2Error: they are not those of this network.
        """
        self.state, self.deform = dict(state), self
        self.is_6dof = "branch_w.weight" in state
        heads = ["branch_w", "branch_v"] if self.is_6dof else ["gaussian_warp"]
        layers = sum(name.startswith("linear.") and name.endswith(".weight") for name in state)
        self.layers = [f"linear.{i}" for i in range(max(layers, 1))]
        needed = [*self.layers, *heads, "gaussian_rotation", "gaussian_scaling"]
        missing = [f"{name}.{part}" for name in needed for part in ("weight", "bias") if f"{name}.{part}" not in state]
        if missing:
            raise D2Error(
                f"{path} has no {missing[0]}: it is no network of Deformable-3D-Gaussians, give the folder that its "
                "train.py wrote"
            )
        self.times = self._frequencies("timenet.0", 1) if "timenet.0.weight" in state else TIME_FREQUENCIES
        from_time = len(state["timenet.2.bias"]) if "timenet.2.bias" in state else 1 + 2 * self.times
        self.positions = self._frequencies("linear.0", 3, from_time)

    def _frequencies(self, layer: str, dimensions: int, besides: int = 0) -> int:
        """How many frequencies a layer's input has, `besides` being what else it sees."""
        return int((self.state[f"{layer}.weight"].shape[1] - besides) // dimensions - 1) // 2

    @torch.no_grad()
    def step(self, positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Offsets of centres [N, 3] (or motions [N, 4, 4]), quaternions [N, 4] and scales [N, 3]."""
        time = encoded(times, self.times)
        if "timenet.0.weight" in self.state:
            time = self._through("timenet.2", self._through("timenet.0", time).relu())
        seen = torch.cat([encoded(positions, self.positions), time], -1)
        hidden = seen
        for name in self.layers:
            again = self.state[f"{name}.weight"].shape[1] > hidden.shape[1]
            hidden = self._through(name, torch.cat([seen, hidden], -1) if again else hidden).relu()
        turned, scaled = self._through("gaussian_rotation", hidden), self._through("gaussian_scaling", hidden)
        if not self.is_6dof:
            return self._through("gaussian_warp", hidden), turned, scaled
        return screw_motions(self._through("branch_w", hidden), self._through("branch_v", hidden)), turned, scaled

    def _through(self, name: str, values: Tensor) -> Tensor:
        return functional.linear(values, self.state[f"{name}.weight"], self.state[f"{name}.bias"])


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """values [N, C] -> [N, C (1 + 2 frequencies)]: themselves, then sine and cosine of each octave."""
    octaves = [wave(values * 2.0**k) for k in range(frequencies) for wave in (torch.sin, torch.cos)]
    return torch.cat([values, *octaves], -1)


def screw_motions(turn: Tensor, shift: Tensor) -> Tensor:
    """Rigid motions [N, 4, 4] of screws: the exponential of (turn, shift), each [N, 3], with angle |turn|."""
    angle = turn.norm(dim=-1, keepdim=True)
    axis, along = turn / angle + AXIS_SHIFT, shift / angle + AXIS_SHIFT
    # Columns are the products of the axis with the unit vectors.
    K = torch.linalg.cross(axis[:, None].expand(-1, 3, -1), torch.eye(3).to(axis).expand(len(axis), -1, -1)).mT
    one, angle = torch.eye(3).to(axis), angle[..., None]
    rotation = one + angle.sin() * K + (1 - angle.cos()) * (K @ K)
    reach = angle * one + (1 - angle.cos()) * K + (angle - angle.sin()) * (K @ K)
    motion = torch.eye(4).to(axis).repeat(len(axis), 1, 1)
    motion[:, :3, :3], motion[:, :3, 3:] = rotation, reach @ along[..., None]
    return motion

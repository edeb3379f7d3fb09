"""The networks that move the Gaussians of other trainers, rebuilt from the names and shapes of their weights.

Deformable-3D-Gaussians: with e(x) = (x, sin 2^k x, cos 2^k x) for k = 0, 1, ..., position and time go encoded through
layers with ReLU; the layer after the middle one sees them a second time. Three linear heads then give the offset of the
centre, of the quaternion and of the scales. In a variant for synthetic scenes two layers encode time first; the one of
rigid motions, `is_6dof`, is not read.

4DGaussians: a point (x, y, z, t) looks into six planes, one for each pair of its coordinates, on several levels; on a
level the six features are multiplied, the levels stand beside each other. One hidden layer or more follows, and a head
of two layers for each attribute that is deformed.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from d2_plugin.errors import D2Error

TIME_FREQUENCIES = 10
"""Of the variant that does not encode time by layers, which alone says it by their widths."""
PAIRS = tuple(itertools.combinations(range(4), 2))
"""Of x, y, z, t: which two coordinates each plane of a level has."""
HEADS = {
    "no_dx": "pos_deform",
    "no_ds": "scales_deform",
    "no_dr": "rotations_deform",
    "no_do": "opacity_deform",
    "no_dshs": "shs_deform",
}
"""The option that leaves an attribute as it is, and the head that else deforms it, in the order of the attributes."""
UNUSED = ("no_grid", "grid_pe", "static_mlp", "empty_voxel", "apply_rotation")
"""Options that no configuration of the repository uses."""


class MotionNetwork:
    """`deform.pth`: an object with the two names that the adapter `deformable3d` uses, `step` and `deform`."""

    def __init__(self, state: Mapping[str, Tensor], path: Path) -> None:
        """Take the weights.

        Raises:
            D2Error: they are not those of this network.
        """
        self.state, self.deform = dict(state), self
        self.heads = ["gaussian_warp", "gaussian_rotation", "gaussian_scaling"]
        layers = sum(name.startswith("linear.") and name.endswith(".weight") for name in state)
        self.layers = [f"linear.{i}" for i in range(max(layers, 1))]
        needed = [*self.layers, *self.heads]
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
        """Offsets of centres [N, 3], quaternions [N, 4] and scales [N, 3]."""
        time = encoded(times, self.times)
        if "timenet.0.weight" in self.state:
            time = _linear(self.state, "timenet.2", _linear(self.state, "timenet.0", time).relu())
        seen = torch.cat([encoded(positions, self.positions), time], -1)
        hidden = seen
        for name in self.layers:
            again = self.state[f"{name}.weight"].shape[1] > hidden.shape[1]
            hidden = _linear(self.state, name, torch.cat([seen, hidden], -1) if again else hidden).relu()
        moved, turned, scaled = (_linear(self.state, name, hidden) for name in self.heads)
        return moved, turned, scaled


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """values [N, C] -> [N, C (1 + 2 frequencies)]: themselves, then sine and cosine of each octave."""
    octaves = [wave(values * 2.0**k) for k in range(frequencies) for wave in (torch.sin, torch.cos)]
    return torch.cat([values, *octaves], -1)


class PlaneField:
    """What the adapter `hust4d` calls as `_deformation`."""

    def __init__(self, state: Mapping[str, Tensor], options: Mapping[str, Any], path: Path) -> None:
        """Take the weights and the options that say which attributes they deform.

        Raises:
            D2Error: other weights, an option that is not known here, or one that is missing.
        """
        for name in UNUSED:
            if options.get(name):
                raise D2Error(f"{path} was trained with {name}, which cannot be shown here: use Viewer(d2) in train.py")
        for name in HEADS:
            if not isinstance(options.get(name), bool):
                raise D2Error(f"the options of {path} do not say {name}: expected the cfg_args that train.py wrote")
        prefix = "deformation_net."
        self.state = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
        self.heads = {name: head for name, head in HEADS.items() if not options[name]}
        needed = ["grid.aabb", "grid.grids.0.5", "feature_out.0.weight", *(f"{head}.3.bias" for head in HEADS.values())]
        missing = [name for name in needed if name not in self.state]
        if missing:
            raise D2Error(f"{path} has no {prefix}{missing[0]}: it is no deformation field of 4DGaussians")

    @property
    def get_aabb(self) -> tuple[Tensor, Tensor]:
        """The corners of the box that the planes span."""
        return self.state["grid.aabb"][0], self.state["grid.aabb"][1]

    @torch.no_grad()
    def __call__(self, *attributes: Tensor) -> tuple[Tensor, ...]:
        """Positions [N, 3], log scales, quaternions, opacity logits [N, 1], harmonics [N, C, 3] and times [N, 1], all
        raw -> the first five at those times."""
        *raw, times = attributes
        first, last = self.get_aabb
        point = torch.cat([(raw[0] - first) * (2 / (last - first)) - 1, times], -1)
        levels = sum(name.startswith("grid.grids.") and name.endswith(".0") for name in self.state)
        hidden = torch.cat([self._level(level, point) for level in range(levels)], -1)
        for layer in sorted({int(name.split(".")[1]) for name in self.state if name.startswith("feature_out.")}):
            hidden = _linear(self.state, f"feature_out.{layer}", hidden.relu() if layer else hidden)
        hidden = hidden.relu()
        deformed = list(raw)
        for place, option in enumerate(HEADS):
            if option in self.heads:
                inner = _linear(self.state, f"{self.heads[option]}.1", hidden).relu()
                deformed[place] = raw[place] + _linear(self.state, f"{self.heads[option]}.3", inner).view_as(raw[place])
        return tuple(deformed)

    def _level(self, level: int, point: Tensor) -> Tensor:
        """The product of the six planes of one level at points [N, 4]: [N, features]."""
        product = torch.ones(())
        for i, pair in enumerate(PAIRS):
            plane, places = self.state[f"grid.grids.{level}.{i}"], point[None, None, :, list(pair)]
            seen = functional.grid_sample(plane, places, align_corners=True, padding_mode="border")
            product = product * seen[0, :, 0].T
        return product


def _linear(state: Mapping[str, Tensor], name: str, values: Tensor) -> Tensor:
    return functional.linear(values, state[f"{name}.weight"], state[f"{name}.bias"])

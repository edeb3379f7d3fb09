"""gsplat 1.6's `contrib.dynamic`: a dict of parameters, of which a HexPlane and a small network deform the moving ones.

    strategy.d2 = D2Hooks.attach("d2.toml", "gsplat_dynamic", params, optimizers, state, hexplane, deform_net,
                                 frames=len(parser.times))         # dynamic_surgical_trainer.py, in train()
    loss = loss + strategy.d2.loss(step + 1, item)                 # in train_step(), before step_pre_backward
    strategy.d2.step(step + 1)                                     # after step_post_backward

Its steps count from 0. The strategy is what both functions of that trainer know.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor, nn

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import unit_quaternions
from d2_plugin.protocol import Points, Splats, View

from ..gsplat_dict import GsplatAdapter, gsplat_view
from ..inverse_deformation import Inversion, invert_some, values_of_neighbours
from ..keys import frame_of_time
from ..shared import finite, splats_of

MASK = "dynamic_mask"
"""Which Gaussians the network deforms, bool [N], in the strategy's state."""


class GsplatDynamicAdapter(GsplatAdapter):
    """Parameters, optimizers and state of a `DynamicStrategy` as a `d2_plugin.protocol.Backbone`.

    Offsets are added to positions, quaternions and logits of opacities; scales and colours stay. An inserted Gaussian
    takes over the mark of the one that is nearest at the time of its frame; if it moves, it is put where the field
    carries it onto its point.

    Args:
        parameters: means, quats, scales (log), opacities [N, 1] (logit), colors [N, 3] (as they are).
        optimizers: one per name.
        state: of `initialize_state`, which holds the mark of each Gaussian.
        hexplane: the `HexPlaneField`.
        deform_net: the `DeformNetwork`.
        frames: how many of them make one unit of time, for cameras that are the data set's items.
        camera: name in the prior store of the camera that took them.
        view: from another camera object to a `View`.
    """

    def __init__(
        self,
        parameters: MutableMapping[str, Tensor],
        optimizers: Mapping[str, torch.optim.Optimizer],
        state: MutableMapping[str, Any],
        hexplane: nn.Module,
        deform_net: nn.Module,
        *,
        frames: int | None = None,
        camera: str = "cam00",
        view: Callable[[object], View] | None = None,
    ) -> None:
        if MASK not in state:
            raise D2Error(f"the strategy's state has no '{MASK}': attach after DynamicStrategy.initialize_state")
        self.hexplane, self.deform_net = hexplane, deform_net
        self.frames, self.camera = frames, camera
        self.inversion: Inversion | None = None
        super().__init__(parameters, optimizers, state, view=view or self._view_of_item)

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable in the parameters, the planes and the network."""
        means, quats, logits = self._deformed(view.time)
        scales, rotations = self.parameters["scales"].exp(), unit_quaternions(quats).T
        return splats_of(means, scales, rotations, torch.sigmoid(logits.squeeze(-1)))

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] as stored."""
        return self.parameters["colors"][splats.rows].clamp(min=0)

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """See `GsplatAdapter.insert`; the new rows are marked as their neighbours are."""
        points = finite(points)
        moving = values_of_neighbours(points, lambda time: self._deformed(time)[0], self._state[MASK])
        if bool(moving.any()):
            points, self.inversion = invert_some(points, moving, self._as_new, self.parameters["means"].detach())
        added = super().insert(points)
        self._state[MASK][len(self) - added :] = moving
        return added

    @property
    def _state(self) -> MutableMapping[str, Any]:
        assert self.state is not None
        return self.state

    def _rows(self, points: Points) -> dict[str, Tensor]:
        """Opacities have a second axis here, and colours no logit."""
        self._new_rows = lambda _: {
            "opacities": torch.logit(points.opacities, eps=1e-6)[:, None],
            "colors": points.colors,
        }
        return super()._rows(points)

    def _deformed(self, time: float) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, quaternions and logits of all rows at an instant; rows without a mark pass as they are."""
        raw = self.parameters["means"], self.parameters["quats"], self.parameters["opacities"]
        moving = torch.nonzero(self._state[MASK]).squeeze(-1)
        if not len(moving):
            return raw
        moved = self._moved(raw[0][moving], raw[1][moving], raw[2][moving], time)
        means, quats, logits = (part.index_copy(0, moving, now) for part, now in zip(raw, moved))
        return means, quats, logits

    def _moved(self, means: Tensor, quats: Tensor, logits: Tensor, time: float) -> tuple[Tensor, Tensor, Tensor]:
        times = means.new_full((len(means), 1), time)
        return self.deform_net(means, quats, logits, times, self.hexplane(torch.cat([means, times], -1)))

    def _as_new(self, positions: Tensor, time: float) -> Tensor:
        """Where rows at these positions would be if all of them moved."""
        count, zeros = len(positions), positions.new_zeros
        return self._moved(positions, zeros(count, 4), zeros(count, 1), time)[0] if count else positions

    def _view_of_item(self, item: object) -> View:
        """An item of its data set: camtoworld, K, time and the image of one frame."""
        if not isinstance(item, Mapping) or self.frames is None:
            given = f"a camera of type {type(item).__name__}" if self.frames is not None else "no number of frames"
            raise D2Error(f"got {given}: pass views, or the data set's items and `frames=`, or give the adapter `view`")
        time, (height, width) = float(item["time"]), item["image"].shape[:2]
        frame = frame_of_time(time, self.frames)
        return gsplat_view(self.camera, frame, time, item["camtoworld"], item["K"], int(width), int(height))

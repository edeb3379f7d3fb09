"""ingra14m/Deformable-3D-Gaussians (CVPR 2024): canonical 3D Gaussians moved by an MLP, `DeformModel`.

adapter = Deformable3DAdapter(gaussians, deform, warm_up=opt.warm_up)
d2 = D2Hooks.from_config("d2.toml", backbone=adapter, iterations=opt.iterations)   # train.py:41
loss = loss + d2.loss(iteration, viewpoint_cam)                                    # before :109
d2.step(iteration)                                                                 # after :163
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import Tensor

from d2_plugin.protocol import Points, Splats, View

from .inria import InriaAdapter
from .inverse_deformation import Inversion, invert_at_times
from .keys import KeyOf
from .shared import once_per_camera, optional, splats_of

log = logging.getLogger(__name__)

NOISE_ENDS = 20_000
"""Iteration at which the noise of times has died down (train.py:53). Before, it grows to a tenth of the clip for the
last views of a round, since it is divided by how many are left."""


class Deformable3DAdapter(InriaAdapter):
    """A `GaussianModel` with its `DeformModel` as a `d2_plugin.protocol.Backbone`.

    The slice is that of its render (gaussian_renderer/__init__.py:70-90): offsets of scales are added AFTER exp and may
    leave a negative scale, offsets of rotations after normalising, and neither the Python side nor the rasterizer
    normalises the sum: its length scales the covariance, and is kept. Before `warm_up` nothing is deformed. The noise
    that training adds to times of real scenes is left out: it has mean zero.

    Args:
        gaussians: the model, after `training_setup`.
        deform: its `DeformModel`.
        warm_up: iteration from which the field is used (opt.warm_up).
        in_warm_up: whether hooks run before it. The trainer's own reports are drawn with the untrained field until
            then, which widens every Gaussian by about .04 units and hides what hooks gain (docs/results/attach.md).
        exact_times: whether training adds no noise to times, as where `dataset.is_blender`: the depth loss then uses
            the offsets that the trainer evaluated for its own render. From iteration 20,000 on it does so anywhere.
        key: finds the prior of a camera; needed where the image's name does not say camera and frame
        (poses_bounds.npy with images 0000.png).
    """

    def __init__(
        self,
        gaussians: Any,
        deform: Any,
        *,
        warm_up: int = 3000,
        in_warm_up: bool = True,
        exact_times: bool = False,
        key: KeyOf | None = None,
    ) -> None:
        super().__init__(gaussians, key, deform.deform)
        self.deform, self.warm_up, self.in_warm_up = deform, warm_up, in_warm_up
        self.exact_times = exact_times
        if warm_up > 1 and not in_warm_up:
            log.info("the trainer uses its field from iteration %d on: hooks wait until then", warm_up)
        self.is_6dof = bool(optional(deform.deform, "is_6dof", False))
        self.inversion: Inversion | None = None
        self._fid = once_per_camera("fid", lambda camera: float(camera.fid))

    def trained(self) -> dict[str, Tensor]:
        """See `InriaAdapter.trained`; the network has an optimizer of its own."""
        network = {f"deform.{name}": value for name, value in self.deform.deform.named_parameters()}
        return super().trained() | network

    @property
    def deforms(self) -> bool:
        """Whether the field is used in the present step, the one given to `begin_step`."""
        return self._step >= self.warm_up

    def active(self, step: int) -> bool:
        """Whether the model can follow time at this step, so that the prior of an instant fits it."""
        return self.in_warm_up or step >= self.warm_up

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable in the model's and in the field's parameters."""
        model = self.gaussians
        opacities = torch.sigmoid(model._opacity.squeeze(-1))
        means, scales, rotations = model._xyz, model._scaling.exp(), torch.nn.functional.normalize(model._rotation)
        if self.deforms:
            inputs = self._offsets, model._xyz.detach(), view.time
            exact = self.exact_times or self._step >= NOISE_ENDS
            motion, rotation, scaling = self._evaluated(view, *inputs) if exact else self._own(*inputs)
            means, scales, rotations = self._moved(means, motion), scales + scaling, rotations + rotation
        return splats_of(means, scales, rotations, opacities)

    def _offsets(self, positions: Tensor, time: float) -> tuple[Tensor, Tensor, Tensor]:
        return self.deform.step(positions, positions.new_full((len(positions), 1), time))

    def _moved(self, positions: Tensor, motion: Tensor) -> Tensor:
        if not self.is_6dof:
            return positions + motion
        return torch.einsum("nij,nj->ni", motion[:, :3, :3], positions) + motion[:, :3, 3]

    def _time(self, camera: Any) -> float:
        return self._fid(camera)

    def _append(self, points: Points) -> None:
        """Canonical Gaussians that the field moves onto the points at the points' times; they exist at all times."""
        if self.deforms:
            self.inversion = invert_at_times(points, self._deformed, self.gaussians._xyz.detach())
            points = points._replace(positions=self.inversion.positions)
        self.gaussians.densification_postfix(*self._raw_rows(points))

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        return self._moved(positions, self._own(self._offsets, positions, time)[0]) if len(positions) else positions

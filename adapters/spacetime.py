"""oppo-us-research/SpacetimeGaussians (CVPR 2024): Gaussians with a temporal radial basis and polynomial motion.

    # train.py:87, after training_setup
    d2 = D2Hooks.attach("d2.toml", "spacetime", gaussians, duration, iterations=opt.iterations)
    loss = loss + d2.loss(iteration, viewpoint_cam)      # before :208, inside the loop over cameras
    d2.step(iteration)                                   # after the optimizer's step at the end (:395)

Line 2 runs once per view; gradients are averaged over the batch afterwards (`set_batch_gradient`), those of D2 too.
"""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import Any

import torch
from torch import Tensor

from d2_plugin.gaussians.rotation4d import unit_quaternions
from d2_plugin.gaussians.slicing import rows_to_draw
from d2_plugin.protocol import Points, ResizeListener, Splats, View

from .inria import InriaAdapter
from .keys import KeyOf, PriorKey, frame_of_time
from .shared import optional, splats_of


class SpacetimeAdapter(InriaAdapter):
    """A `GaussianModel` of oursfull.py or ourslite.py as a `d2_plugin.protocol.Backbone`.

    Its render (renderer/__init__.py:78-92) multiplies the opacity by exp(-(d / s)^2), without a half, with d the time
    since the Gaussian's own, and moves it by a cubic in d through which no gradient flows to that time.

    Args:
        gaussians: the model, after `training_setup`.
        duration: number of frames, the variable of that name in train.py; timestamps are frame / duration.
        first_frame: number of the frame at time 0.
        key: finds the prior of a camera; needed where `image_name` is not the camera's name in the prior store.
    """

    pruning = ("prune_points", "prune_pointswithemsmask")
    evidence = InriaAdapter.evidence | {"omegamask": 1.0}
    """From iteration 8001 on gradients of `_omega` are multiplied by `omegamask`, which insertion does not extend."""

    def __init__(self, gaussians: Any, duration: int, *, first_frame: int = 0, key: KeyOf | None = None) -> None:
        super().__init__(gaussians, key)
        self.duration, self.first_frame = duration, first_frame
        self._fading: Tensor | None = None

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener; D2Hooks does so only where a hook is on. Then what its render evaluates is kept."""
        super().on_resize(listener)
        model = self.gaussians
        if "get_rotation" not in self._overridden:
            asked, self._overridden["get_rotation"] = model.get_rotation, vars(model).get("get_rotation")
            model.get_rotation = lambda since: self._rotated(asked(since), since)

    def _rotated(self, rotations: Tensor, since: Tensor) -> Tensor:
        """Keep what its render has just evaluated; a render that leaves no new `trbfoutput` is not used."""
        fading = optional(self.gaussians, "trbfoutput")
        if fading is not None and fading is not self._fading:
            self._fading = fading
            self._keep((rotations, since, fading))
        return rotations

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`; those too faint for the rasterizer to draw are left out."""
        model = self.gaussians
        rotations, since, fading = self._evaluated(view, self._at, view.time)
        opacities = torch.sigmoid(model._opacity[:, 0]) * fading[:, 0]
        rows = rows_to_draw(opacities.detach() >= self.settings.alpha_min)  # the rasterizer leaves out the faint itself
        first, second, third = model._motion[rows].split(3, 1)
        since = since[rows]
        means = model._xyz[rows] + first * since + second * since**2 + third * since**3
        return splats_of(means, model._scaling[rows].exp(), rotations[rows], opacities[rows], rows)

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] as stored, which is the lite model's; the full model's decoder is left out."""
        return self.gaussians._features_dc[splats.rows, :3].clamp(min=0)

    def _at(self, time: float) -> tuple[Tensor, ...]:
        """Of all rows: unit quaternions, the time since their own, and the share that it leaves of their opacity."""
        model = self.gaussians
        since = time - model._trbf_center
        rotations = unit_quaternions(model._rotation + since.detach() * model._omega).T
        return rotations, since.detach(), torch.exp(-((since / model._trbf_scale.exp()) ** 2))

    def _default_key(self, camera: Any) -> PriorKey:
        """Camera by `image_name`, frame by time: one name stands for all instants."""
        frame = frame_of_time(self._time(camera), self.duration, self.first_frame)
        return PriorKey(PurePosixPath(str(camera.image_name)).stem, frame)

    def _append(self, points: Points) -> None:
        """Gaussians that do not move, centred on the time of their frame, as wide in time as the initial ones.

        Where a lifetime is shorter, it counts: exp(-(dt / e^s)^2) has the standard deviation e^s / sqrt(2).

        Colours are stored as they are, twice in the full model, whose second half and `_features_t` feed its decoder.
        """
        model, rows, count = self.gaussians, self._raw_rows(points), len(points.positions)
        zeros = points.positions.new_zeros
        widths = points.positions.new_full((count, 1), float(optional(model, "trbfslinit", 1.0)))
        if points.lifetimes is not None:
            widths = torch.minimum(widths, (points.lifetimes * math.sqrt(2)).log()[:, None])
        colors = points.colors.repeat(1, model._features_dc.shape[1] // 3)
        still = points.times[:, None], widths, zeros(count, 9), zeros(count, 4)  # centre, width, motion, omega
        shape = rows.opacity, rows.scaling, rows.rotation
        model.densification_postfix(rows.xyz, colors, *shape, *still, zeros(count, 3))

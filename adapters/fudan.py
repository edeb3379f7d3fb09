"""fudan-zvg/4d-gaussian-splatting (Yang et al., ICLR 2024) and 4C4D, its fork: native 4D Gaussians, sliced at t.

    adapter = FudanAdapter(gaussians, scene)                                           # after training_setup, restore
    d2 = D2Hooks.from_config("d2.toml", backbone=adapter, iterations=opt.iterations)   # train.py:52
    loss = loss + d2.loss(iteration, viewpoint_cam)                                    # before `/ batch_size` (:162)
    d2.step(iteration)                                                                 # after zero_grad (:249)

Line 2 lies before the division: it runs once per view, and the mean over the batch is then taken of both losses alike.
"""

from __future__ import annotations

import logging
import math
from typing import Any

import torch
from torch import Tensor

from d2_plugin.gaussians.rotation4d import (
    condition_on_time,
    covariances_from_factors,
    rotation_matrices_4d,
    temporal_marginal,
    time_row,
    unit_quaternions,
)
from d2_plugin.gaussians.slicing import MARGINAL_CUT, slice_gaussians
from d2_plugin.protocol import Points, ResizeListener, Splats, View

from .cameras import correct_fields_of_view
from .inria import InriaAdapter
from .keys import KeyOf
from .shared import optional, seen_colors, splats_of

log = logging.getLogger(__name__)


class FudanAdapter(InriaAdapter):
    """One `GaussianModel` of fudan-zvg/4d-gaussian-splatting or 4C4D as a `d2_plugin.protocol.Backbone`.

    All its variants are sliced as its rasterizer does it (forward.cu:279-352): rot_4d or not, gaussian_dim 3 or 4,
    with `prefilter_var` or without. 4C4D writes decayed opacities back into `_opacity`, so the stored ones are right.

    Args:
        gaussians: the model, after `training_setup` and, when resuming, after `restore`.
        scene: its `Scene`; where transforms.json carries focal lengths, the fields of view of its cameras are -1 and
            get corrected (see `correct_fields_of_view`), but only if a hook is on: without hooks nothing changes.
        correct_fov: False leaves the fields of view alone, to continue a model that was trained with them.
        key: finds the prior of a camera; needed where the image's name does not say camera and frame.
    """

    evidence = InriaAdapter.evidence | {"t_gradient_accum": 0.0}

    def __init__(
        self,
        gaussians: Any,
        scene: Any = None,
        *,
        correct_fov: bool = True,
        key: KeyOf | None = None,
    ) -> None:
        super().__init__(gaussians, key)
        self._scene, self._correct_fov, self._warned = scene, correct_fov, False

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener; D2Hooks does so only where a hook is on, so this is when cameras are corrected."""
        super().on_resize(listener)
        if self._scene is not None and self._correct_fov:
            splits = (self._scene.train_cameras, self._scene.test_cameras)
            count = sum(correct_fields_of_view(cameras) for split in splits for cameras in split.values())
            if count:
                log.warning("%d cameras had a field of view of -1: set from their focal lengths (issue 64)", count)

    def view(self, camera: Any) -> View:
        """See `InriaAdapter.view`; a camera whose field of view is still -1 is named once."""
        if optional(camera, "FoVx", 0) == -1 and not self._warned:
            log.warning(
                "camera '%s' has a field of view of -1, so the trainer draws footprints of another size than D2 "
                "surveys: give the adapter the scene, which corrects it",
                camera.image_name,
            )
            self._warned = True
        return super().view(camera)

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`; those with F(t) <= 0.05 are left out, as in the rasterizer."""
        model = self.gaussians
        raw = {
            "positions": model._xyz,
            "log_scales": model._scaling,
            "left": model._rotation,
            "opacity_logits": model._opacity.squeeze(-1),
        }
        if model.gaussian_dim == 3:
            return slice_gaussians(raw)
        if model.rot_4d and not _prefilter(model):
            time = {"times": model._t.squeeze(-1), "log_time_scales": model._scaling_t.squeeze(-1)}
            return slice_gaussians(raw | time | {"right": model._rotation_r}, view.time)
        return self._slice_rotated(view.time) if model.rot_4d else self._slice_unrotated(view.time)

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3], seen along the ray to the unsliced centre; with cosines in time at the third degree alone
        (forward.cu:71-175)."""
        model, time_degree = self.gaussians, int(optional(self.gaussians, "active_sh_degree_t", 0))
        splats = splats._replace(means=model._xyz[splats.rows])
        flat = model.gaussian_dim == 3 or optional(model, "force_sh_3d", False)
        if not time_degree or flat or model.active_sh_degree < 3:
            return super().colors(view, splats)
        phase = (view.time - model._t[splats.rows, 0]) / (model.time_duration[1] - model.time_duration[0])
        return seen_colors(self._harmonics(), view, splats, int(model.active_sh_degree), phase, time_degree)

    def _slice_rotated(self, time: float) -> Splats:
        """With `prefilter_var` added to the temporal variance, in the marginal alone (gaussian_model.py:244)."""
        model = self.gaussians
        log_scales, extra = torch.cat([model._scaling, model._scaling_t], 1), _prefilter(model)
        with torch.no_grad():
            axes = unit_quaternions(model._rotation), unit_quaternions(model._rotation_r)
            variance = (time_row(*axes) * log_scales.T.exp()).square().sum(0) + extra
            rows = self._alive(time, variance)
        left, right = unit_quaternions(model._rotation[rows]), unit_quaternions(model._rotation_r[rows])
        factors = rotation_matrices_4d(left, right) * log_scales[rows].T.exp()
        spatial, velocity = condition_on_time(factors)
        offset = time - model._t[rows, 0]
        marginal = temporal_marginal(offset, factors[3].square().sum(0) + extra)
        means = model._xyz[rows] + (velocity * offset).T
        opacities = torch.sigmoid(model._opacity[rows, 0]) * marginal
        return Splats(means, covariances_from_factors(spatial), opacities, rows)

    def _slice_unrotated(self, time: float) -> Splats:
        """Without 4D rotation nothing moves, and `_scaling_t` is read as the log of the VARIANCE (forward.cu:433)."""
        model = self.gaussians
        extra = _prefilter(model)
        with torch.no_grad():
            rows = self._alive(time, model._scaling_t[:, 0].exp() + extra)
        marginal = temporal_marginal(time - model._t[rows, 0], model._scaling_t[rows, 0].exp() + extra)
        opacities = torch.sigmoid(model._opacity[rows, 0]) * marginal
        rotations = unit_quaternions(model._rotation[rows]).T
        return splats_of(model._xyz[rows], model._scaling[rows].exp(), rotations, opacities, rows)

    def _alive(self, time: float, variance: Tensor) -> Tensor:
        marginal = temporal_marginal(time - self.gaussians._t[:, 0], variance)
        return torch.nonzero(marginal > MARGINAL_CUT).squeeze(-1)

    def _append(self, points: Points) -> None:
        """New Gaussians live around the time of their frame with the width that the repository starts with, a variance
        of a fifth of the duration (gaussian_model.py:280), or with their lifetime where that is shorter.

        Without 4D rotation `_scaling_t` is read as the log of the variance."""
        model, rows = self.gaussians, self._raw_rows(points)
        times = scales = right = None
        if model.gaussian_dim == 4:
            duration = model.time_duration[1] - model.time_duration[0]
            times = points.times[:, None]
            scales = torch.full_like(times, 0.5 * math.log(duration / 5))
            if points.lifetimes is not None:
                scales = torch.minimum(scales, points.lifetimes.log()[:, None] * (1 if model.rot_4d else 2))
            right = rows.rotation.clone() if model.rot_4d else None
        model.densification_postfix(*rows, times, scales, right)


def _prefilter(model: Any) -> float:
    """Variance added to every temporal extent; 0 where it is off (negative) or unknown (older snapshots, 4C4D)."""
    return max(optional(model, "prefilter_var", 0.0), 0.0)

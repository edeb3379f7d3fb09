"""nerficg-project/faster-gaussian-splatting, branch FasterGS4D (CVPR 2026): Yang's 4D Gaussians, trained the fastest.

    self.d2 = D2Hooks.attach("d2.toml", "fastergs4d", self.model.gaussians)     # Trainer.py:96, end of setup_gaussians
    loss = loss + self.d2.loss(iteration + 1, view) / self.BATCH_SIZE           # before loss.backward() (:168)
    self.d2.step(iteration + 1)                                                 # after optimizer.zero_grad() (:180)

Its rasterizer returns an image and nothing else, so depth comes from ours. It counts iterations from 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import identities
from d2_plugin.gaussians.slicing import slice_gaussians
from d2_plugin.gaussians.spherical_harmonics import coefficients_from_rgb
from d2_plugin.protocol import Points, RasterSettings, Splats, View

from ..keys import KeyOf, PriorKey, key_from_image_name
from ..shared import Resizing, appended, finite, on_device, optional, seen_colors, with_rows

CONSTANTS = RasterSettings(alpha_max=1 - 1e-6)
"""Of its rasterizer (rasterization_config.h): alpha is not clamped; near comes from the camera."""

LEFT_SIGNS, RIGHT_SIGNS = (1.0, -1.0, 1.0, -1.0), (1.0, -1.0, 1.0, 1.0)
"""From its quaternions to Yang's. It rotates v = x + yi + zj + tk as l v r, Yang w = t + zi + yj + xk as l w conj(r).
Reversing the order of the axes is w = j v (-i), hence l' = j l j and r' = conj(i r i) up to a common sign."""


class FasterGS4DAdapter(Resizing):
    """A `Gaussians` of FasterGS4D as a `d2_plugin.protocol.Backbone`.

    Rows change in two methods only: `prune`, after `adaptive_density_control` has appended, and `sort`, which orders
    all rows by place and time every 5,000 iterations. Both are overridden on the instance.

    Args:
        gaussians: `model.gaussians`, after `training_setup`.
        duration: of the clip in the unit of `view.timestamp`, which its data sets bring to 0..1.
        key: finds the prior of a view; needed where the image's path does not say camera and frame.
    """

    settings = CONSTANTS

    def __init__(self, gaussians: Any, duration: float = 1.0, *, key: KeyOf | None = None) -> None:
        super().__init__()
        missing = [name for name in ("prune", "sort", "_temporal_means") if not hasattr(gaussians, name)]
        if missing:
            raise D2Error(
                f"{type(gaussians).__name__} has no {missing[0]}, which FasterGS4DAdapter needs: "
                "give it model.gaussians of the branch FasterGS4D"
            )
        self.gaussians, self.duration = gaussians, duration
        self._key = key
        self._reported = len(self)
        self._watch("prune", lambda mask: torch.nonzero(~mask).squeeze(-1))
        self._watch("sort", lambda ordering: ordering)

    def __len__(self) -> int:
        return len(self.gaussians._spatial_means)

    def view(self, camera: Any) -> View:
        """The view of NeRFICG's `View` (Datasets/utils.py), which holds camera, pose and time, or a `View` as it is."""
        if isinstance(camera, View):
            return on_device(camera, self.gaussians._spatial_means)
        lens = optional(camera, "camera")
        if lens is None or not hasattr(lens, "focal_x"):
            kind = type(camera).__name__
            raise D2Error(f"a camera of type {kind} has no perspective `camera`: pass the trainer's view")
        key = self._key(camera) if self._key is not None else _key_of_image(camera)
        like = self.gaussians._spatial_means
        K = torch.tensor([[lens.focal_x, 0, lens.center_x], [0, lens.focal_y, lens.center_y], [0, 0, 1]])
        pose, size = camera.w2c.detach().to(like, non_blocking=True).contiguous(), (int(lens.width), int(lens.height))
        return View(key.camera, key.frame, float(camera.timestamp), pose, K.to(like, non_blocking=True), *size)

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`; those with F(t) below 0.05 are left out, as in its rasterizer."""
        model = self.gaussians
        return slice_gaussians(
            {
                "positions": model._spatial_means,
                "log_scales": model._spatial_scales,
                "left": _signed(model._left_isoclinic_rotations, LEFT_SIGNS),
                "opacity_logits": model._opacities.squeeze(-1),
                "times": model._temporal_means.squeeze(-1),
                "log_time_scales": model._temporal_scales.squeeze(-1),
                "right": _signed(model._right_isoclinic_rotations, RIGHT_SIGNS),
            },
            view.time,
        )

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] from the spherical harmonics in use."""
        model = self.gaussians
        harmonics = torch.cat([model._sh_coefficients_0, model._sh_coefficients_rest], 1)
        return seen_colors(harmonics, view, splats, int(model.active_sh_degree))

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """Isotropic Gaussians at the finite ones of the points, at the end; returns their number.

        They live around the time of their frame with the width that the repository starts with, a variance of a fifth
        of the duration, or with their lifetime where that is shorter. `_densification_info` is kept, with zeros for the
        new rows.
        """
        points, model, before = finite(points), self.gaussians, len(self)
        rows, added = self._rows(points), len(points.positions)
        for group in model.optimizer.param_groups:
            name = group["name"]
            setattr(model, f"_{name}", with_rows(model.optimizer, group["params"][0], rows[name]))
        evidence = model._densification_info
        if evidence is not None:
            model._densification_info = torch.cat([evidence, evidence.new_zeros(len(evidence), added)], 1)
        self._report(appended(before, len(self), points.positions.device))
        return added

    @torch.no_grad()
    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True, by the repository's own function."""
        self.gaussians.prune(mask)

    def _rows(self, points: Points) -> dict[str, Tensor]:
        model, count = self.gaussians, len(points.positions)
        extents = points.times.new_full((count, 1), 0.5 * math.log(self.duration / 5))
        if points.lifetimes is not None:
            extents = torch.minimum(extents, points.lifetimes.log()[:, None])
        return {
            "spatial_means": points.positions,
            "temporal_means": points.times[:, None],
            "sh_coefficients_0": coefficients_from_rgb(points.colors, 0, 0),
            "sh_coefficients_rest": points.positions.new_zeros(count, *model._sh_coefficients_rest.shape[1:]),
            "opacities": torch.logit(points.opacities, eps=1e-6)[:, None],
            "spatial_scales": points.scales.log()[:, None].repeat(1, 3),
            "temporal_scales": extents,
            "left_isoclinic_rotations": identities(count, points.positions),
            "right_isoclinic_rotations": identities(count, points.positions),
        }

    def _watch(self, name: str, kept: Callable[[Tensor], Tensor]) -> None:
        """Override a method on the instance: `kept` gives the rows that its argument keeps, in their new order."""
        original = getattr(type(self.gaussians), name).__get__(self.gaussians)

        def reporting(argument: Tensor) -> None:
            rows = kept(argument)
            index = torch.where(rows < self._reported, rows, -1)  # beyond: appended since the last report
            original(argument)
            self._report(index)

        object.__setattr__(self.gaussians, name, reporting)

    def _report(self, index: Tensor) -> None:
        self._reported = len(self)
        super()._report(index)


def _key_of_image(view: Any) -> PriorKey:
    """Its data sets number frames through all cameras; only the path of the image says which is which."""
    image = optional(view, "_rgb")
    if image is None:
        raise D2Error("a view without an image does not say its camera: give the adapter a function `key`")
    return key_from_image_name(str(image.path))


def _signed(quaternions: Tensor, signs: Sequence[float]) -> Tensor:
    """Quaternions [N, 4] with each component times its sign; by Python's numbers, which a GPU gets without a wait."""
    return torch.stack([sign * part for sign, part in zip(signs, quaternions.unbind(-1))], -1)

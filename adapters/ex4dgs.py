"""juno181/Ex4DGS (NeurIPS 2024): static Gaussians with a drift, and dynamic ones between key frames.

    d2 = D2Hooks.attach("d2.toml", "ex4dgs", gaussians, near=dataset.near, far=dataset.far,
                        iterations=opt.iterations)       # train.py:50 (or restore)
    loss = loss + d2.loss(iteration, viewpoint_cam)      # before :170
    d2.step(iteration)                                   # after prune_nan_points

The contract's rows are those of its render: all static Gaussians, then all dynamic ones. Rows that the repository
appends to the first table therefore land in the middle of the second's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import torch
from torch import Tensor

from d2_plugin.gaussians.slicing import rows_to_draw
from d2_plugin.protocol import Points, Splats, View, covariance_matrices

from .inria import InriaAdapter
from .keys import KeyOf, PriorKey, key_from_image_name, key_of_technicolor
from .shared import splats_of

SMALL = 1e-6
"""Guards of the rasterizer's opacity compensation (cuda_rasterizer/forward.cu, computeCov2D)."""

FRUSTUM = 1.3
"""Gaussians whose centre projects beyond this multiple of the half image are not drawn (auxiliary.h, in_frustum)."""


class Ex4DGSAdapter(InriaAdapter):
    """A `CGaussianModel` as a `d2_plugin.protocol.Backbone`.

    Static Gaussians keep raw quaternions, and the rasterizer does not normalise either: their length scales the
    covariance. It blurs by `kernel_size` (0.1) and lowers opacities to match, and draws depths in near..far only.
    Inserted Gaussians are static ones without drift; the repository makes dynamic ones of those that do not fit.

    Args:
        gaussians: the model, after `training_setup` and, when resuming, after `restore`.
        near, far: dataset.near and dataset.far.
        first_frame: number of the frame whose image is 0.png, where the prior counts from elsewhere.
        key: finds the prior of a camera; needed where the image's path does not say camera and frame.
    """

    appending = ("densification_postfix", "densification_postfix_onlystatic")
    evidence = dict.fromkeys(
        (*InriaAdapter.evidence, "xyz_error_accum", "xyz_ssim_error_accum", "error_denom"), 0.0
    ) | {"min_radii2D": 1000.0, "xyz_error_min": 1000.0, "xyz_error_min_timestamp": -1.0}
    """Also the two that the repository's callers extend by hand: without them its next prune_points fails."""

    def __init__(
        self,
        gaussians: Any,
        *,
        near: float = 0.2,
        far: float = 1e10,
        first_frame: int = 0,
        key: KeyOf | None = None,
    ) -> None:
        super().__init__(gaussians, key)
        self.settings = replace(self.settings, near=near, blur=float(gaussians.kernel_size))
        self.far, self.first_frame = far, first_frame
        self._reported = self._sizes()

    def __len__(self) -> int:
        return sum(self._sizes())

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, opacities compensated for the blur of this view's pixels."""
        model, time = self.gaussians, view.time
        means = model.get_xyz_at_t(time)
        camera = means @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
        inside = self._in_frustum(camera.detach(), view)
        rows = rows_to_draw(inside)
        if camera.is_cuda:
            camera = torch.where(inside[:, None], camera, 1.0)  # in front, where nothing is divided by 0
        scales, rotations = model.get_scaling()[rows], model.get_rotation_at_t(time)[rows]
        splats = splats_of(means[rows], scales, rotations, model.get_opacity_at_t(time)[rows, 0], rows)
        compensation = self._compensation(camera[rows], splats.covariances, view)
        opacities = splats.opacities * compensation
        return splats._replace(opacities=torch.where(inside, opacities, 0.0) if camera.is_cuda else opacities)

    def _harmonics(self) -> Tensor:
        model = self.gaussians
        static = torch.cat([model._features_dc, model._features_rest], 1)
        return torch.cat([static, torch.cat([model._features_dc_motion, model._features_rest_motion], 1)])

    def _in_frustum(self, camera: Tensor, view: View) -> Tensor:
        """Which centres [N, 3] in camera axes the rasterizer draws."""
        z = camera[:, 2]
        pixels = camera @ view.K.T[:, :2] / z[:, None].clamp_min(SMALL)
        columns, rows = (2 * pixels[:, axis] / size - 1 for axis, size in enumerate((view.width, view.height)))
        within = (columns.abs() <= FRUSTUM) & (rows.abs() <= FRUSTUM)
        return (z > self.settings.near) & (z <= self.far) & within

    def _compensation(self, camera: Tensor, covariances: Tensor, view: View) -> Tensor:
        """sqrt(det C / det (C + blur)) of the projected covariances C, [M], with the rasterizer's guards."""
        x, y, z = camera.unbind(-1)
        fx, fy = view.K[0, 0], view.K[1, 1]
        zero = torch.zeros_like(z)
        J = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).view(-1, 2, 3)
        A = J @ view.T_camera_world[:3, :3]
        C = A @ covariance_matrices(covariances) @ A.transpose(1, 2)
        a, b, c = C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]
        blur = self.settings.blur
        sharp = a * c - b * b
        ratio = sharp.clamp_min(SMALL) / (((a + blur) * (c + blur) - b * b).clamp_min(SMALL) + SMALL)
        return torch.where(sharp > SMALL, torch.sqrt(ratio + SMALL), zero)

    @torch.no_grad()
    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True, from both tables."""
        static = self._sizes()[0]
        self.gaussians.prune_points(mask[:static], mask[static:])

    def _append(self, points: Points) -> None:
        rows = self._raw_rows(points)
        self.gaussians.densification_postfix_onlystatic(*rows, torch.zeros_like(rows.xyz))

    def _default_key(self, camera: Any) -> PriorKey:
        """From the path of the image: `image_name` is the file's name, which for N3V says the frame alone.

        Images are CAMERA/FRAME.png (N3V) or SCENE_undist_FRAME_CAMERA.png (Technicolor, dataset_readers.py:143).
        """
        image = self.image_name(camera) or str(camera.image_name)
        in_folders = PurePosixPath(image).stem.isdigit()
        key = key_from_image_name(image) if in_folders else key_of_technicolor(image)
        return key._replace(frame=self.first_frame + key.frame)

    def _sizes(self) -> tuple[int, int]:
        return len(self.gaussians._xyz), len(self.gaussians._xyz_motion)

    def _before_append(self, *_: Any, **__: Any) -> Callable[[], Tensor]:
        return lambda: self._index(*(torch.arange(size) for size in self._sizes()))

    def _before_prune(self, static_mask: Tensor, dynamic_mask: Tensor) -> Callable[[], Tensor]:
        kept = (torch.nonzero(~mask.bool()).squeeze(-1) for mask in (static_mask, dynamic_mask))
        index = self._index(*kept)

        def report() -> Tensor:
            self._reported = self._sizes()
            return index

        return report

    def _index(self, static: Tensor, dynamic: Tensor) -> Tensor:
        """Present rows of both tables as rows that listeners know of; -1 beyond those.

        `extract_dynamic_points_from_static` appends to the second table by itself and then prunes the first, so what
        it appended is first seen here.
        """
        before, self._reported = self._reported, self._sizes()
        device = self.gaussians._xyz.device
        static, dynamic = static.to(device), dynamic.to(device)
        static = torch.where(static < before[0], static, -1)
        dynamic = torch.where(dynamic < before[1], dynamic + before[0], -1)
        return torch.cat([static, dynamic])

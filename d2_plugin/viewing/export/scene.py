"""A trained run as plain data for export: Gaussians at any instant, cameras, frames, and how large things look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import coefficients_from_rgb
from d2_plugin.protocol import Splats
from d2_plugin.recordings import Camera
from d2_plugin.viewing.camera_paths import Rig, at_pose
from d2_plugin.viewing.export.ply import scales_and_rotations
from d2_plugin.viewing.viewed import ViewedRun


@dataclass(frozen=True, eq=False)
class ExportScene:
    """What the formats write."""

    viewed: ViewedRun
    harmonics: Harmonics
    splats_at: Callable[[float], Splats]
    """The 3D Gaussians at a time in seconds; float32, without gradients."""
    moving: MovingGaussians | None = None
    """The same as straight lines that fade, where the model is of that form."""
    background: Tensor | None = None
    """Spherical harmonics [16, 3] of what lies behind all Gaussians."""

    @property
    def seconds(self) -> tuple[float, ...]:
        """Time of each frame since the first one."""
        return tuple(map(self.viewed.recording.seconds, self.viewed.recording.frames))

    def pixels_per_unit(self, positions: Tensor) -> Tensor:
        """Length [M] in pixels of one world unit across the line of sight, in the training camera that sees a position
        [M, 3] largest; 0 where none does."""
        largest = positions.new_zeros(len(positions))
        for camera in self.viewed.training:
            depth = self._seen_depth(camera, positions)
            largest = torch.maximum(largest, torch.where(depth > 0, camera.K[0, 0] / depth.clamp(min=1e-30), 0))
        return largest

    def _seen_depth(self, camera: Camera, positions: Tensor) -> Tensor:
        """Depth [M] of positions [M, 3] in a camera; 0 for those outside of its image."""
        pose, K = (torch.as_tensor(matrix).to(positions) for matrix in (camera.T_camera_world, camera.K))
        points = positions @ pose[:3, :3].T + pose[:3, 3]
        depth = points[:, 2]
        pixels = (points[:, :2] * K.diagonal()[:2]) / depth.clamp(min=self.viewed.backbone.settings.near)[:, None] + K[
            :2, 2
        ]
        inside = ((pixels > 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))).all(1)
        return torch.where((depth > self.viewed.backbone.settings.near) & inside, depth, 0)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Training cameras, then those that are held out."""
        names = (*self.viewed.train_cameras, *self.viewed.test_cameras)
        return tuple(self.viewed.recording.cameras[name] for name in names)

    def outlook(self) -> dict[str, Any]:
        """Where a player may start and how far it may go, in world units: `focus` is what the cameras look at, `up`, a
        camera `home`, `limits`, and `depth_range` from the hundredth-nearest to the hundredth-farthest opaque Gaussian
        that a training camera sees, at the first, the middle and the last frame."""
        depths = []
        for time in sorted({self.seconds[0], self.seconds[len(self.seconds) // 2], self.seconds[-1]}):
            splats = self.splats_at(time)
            opaque = splats.means[splats.opacities > 0.5].double()
            depths += [self._seen_depth(camera, opaque) for camera in self.viewed.training]
        seen = torch.cat(depths)
        known = seen[seen > 0].numpy()
        near, middle, far = np.quantile(known, [0.01, 0.5, 0.99]) if len(known) else (1.0, 1.5, 2.0)
        rig, ends = Rig.of(self.cameras, float(middle)), [float(near), float(max(far, near * (1 + 1e-6)))]
        home = at_pose(self.cameras[0], rig.home)
        places = {"focus": rig.focus.tolist(), "up": rig.up.tolist(), "limits": rig.limits(self.cameras)}
        return places | {"home": home, "depth_range": ends}

    def still_at(self, time: float) -> tuple[MovingGaussians, tuple[Tensor, Tensor]]:
        """The Gaussians of one instant with its colours, and their scales [M, 3] and quaternions [M, 4]."""
        splats = self.splats_at(time)
        own = self.harmonics._replace(coefficients=self.harmonics.coefficients[splats.rows])
        phase = None
        if self.moving is not None and self.moving.motion is not None and own.time_degree:
            phase = (time - self.moving.motion.times[splats.rows]) / max(self.viewed.duration, 1e-12)
        means, covariances, opacities = (part.double() for part in splats[:3])
        still = MovingGaussians(means, covariances, opacities, Harmonics(own.without_time(phase), own.degree))
        if self._lasting_shapes is None:
            return still, scales_and_rotations(covariances)
        scales, rotations = self._lasting_shapes
        return still, (scales[splats.rows], rotations[splats.rows])

    @cached_property
    def _lasting_shapes(self) -> tuple[Tensor, Tensor] | None:
        """Those of all Gaussians where they are the same at all times: finding them takes as long as all else."""
        return None if self.moving is None else scales_and_rotations(self.moving.covariances)


@torch.no_grad()
def export_scene(viewed: ViewedRun) -> ExportScene:
    """What is exported of a run or a checkpoint."""
    backbone, moving = viewed.backbone, viewed.moving
    view = viewed.view(viewed.training[0], 0.0)
    model: Any = getattr(backbone, "model", None)  # of the bundled backbones

    @torch.no_grad()
    def splats_at(time: float) -> Splats:
        at = replace(view, time=viewed.time_offset + time * viewed.time_scale)
        return Splats(*(part.detach().cpu() for part in backbone.slice_at(at)))

    if viewed.harmonics is not None:
        harmonics = viewed.harmonics
    elif hasattr(model, "harmonics"):
        own: Harmonics = model.harmonics()
        harmonics = own._replace(coefficients=own.coefficients.detach().double().cpu())
    else:  # the colours that one camera sees, for every direction
        splats, colors = backbone.slice_at(view), torch.zeros(len(backbone), 3)
        colors[splats.rows.cpu()] = backbone.colors(view, splats).detach().cpu()
        harmonics = Harmonics(coefficients_from_rgb(colors, 0, 0).double(), 0)
    if moving is None and hasattr(model, "moving"):
        moving = model.moving()
    behind = getattr(model, "background", None)
    background = None if behind is None else torch.cat([behind.constant, behind.harmonics]).detach().double().cpu()
    return ExportScene(viewed, harmonics, splats_at, moving, background)

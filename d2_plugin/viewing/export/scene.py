"""A trained run as plain data for export: Gaussians at any instant, cameras, clip, and how large things look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import coefficients_from_rgb
from d2_plugin.protocol import RasterSettings, Splats, View
from d2_plugin.recordings import Camera
from d2_plugin.runs.gaussian_ply import scales_and_rotations
from d2_plugin.runs.run import Run
from d2_plugin.runs.start import make_view


@dataclass(frozen=True, eq=False)
class Clip:
    """The instants of a scene."""

    frames: tuple[int, ...]
    """Numbers of the frames, as the recording has them."""
    seconds: tuple[float, ...]
    """Time of each frame since the first one."""
    fps: float

    @property
    def duration(self) -> float:
        """From the first frame to the last, seconds; 0 for one frame."""
        return self.seconds[-1]


@dataclass(frozen=True, eq=False)
class ExportScene:
    """What the formats write."""

    name: str
    clip: Clip
    train_cameras: tuple[Camera, ...]
    test_cameras: tuple[Camera, ...]
    raster: RasterSettings
    harmonics: Harmonics
    splats_at: Callable[[float], Splats]
    """The 3D Gaussians at a time in seconds; float32, without gradients."""
    moving: MovingGaussians | None = None
    """The same as straight lines that fade, where the model is of that form."""
    background: Tensor | None = None
    """Spherical harmonics [16, 3] of what lies behind all Gaussians."""

    def pixels_per_unit(self, positions: Tensor) -> Tensor:
        """Length [M] in pixels of one world unit across the line of sight, in the training camera that sees a position
        [M, 3] largest; 0 where none does."""
        largest = positions.new_zeros(len(positions))
        for camera in self.train_cameras:
            pose = torch.as_tensor(camera.T_camera_world).to(positions)
            intrinsics = torch.as_tensor(camera.K).to(positions)
            points = positions @ pose[:3, :3].T + pose[:3, 3]
            depth = points[:, 2].clamp(min=self.raster.near)
            pixels = (points[:, :2] * intrinsics.diagonal()[:2]) / depth[:, None] + intrinsics[:2, 2]
            size = pixels.new_tensor([camera.width, camera.height])
            seen = (points[:, 2] > self.raster.near) & ((pixels > 0) & (pixels < size)).all(1)
            largest = torch.maximum(largest, torch.where(seen, intrinsics[0, 0] / depth, 0))
        return largest

    def still_at(self, time: float) -> MovingGaussians:
        """The Gaussians of one instant, with the colours of that instant."""
        return self.still(self.splats_at(time), time)

    def still(self, splats: Splats, time: float) -> MovingGaussians:
        """See `still_at`, of the Gaussians of that instant."""
        rows = splats.rows.cpu()
        own = self.harmonics._replace(coefficients=self.harmonics.coefficients[rows])
        phase = None
        if self.moving is not None and self.moving.motion is not None and own.time_degree:
            phase = (time - self.moving.motion.times[rows]) / max(self.clip.duration, 1e-12)
        still = Harmonics(own.without_time(phase), own.degree)
        means, covariances, opacities = (part.double() for part in splats[:3])
        return MovingGaussians(means, covariances, opacities, still)

    def shapes(self, splats: Splats) -> tuple[Tensor, Tensor]:
        """Scales [M, 3] and quaternions [M, 4] of the Gaussians of one instant."""
        if self._lasting_shapes is None:
            return scales_and_rotations(splats.covariances.double())
        scales, rotations = self._lasting_shapes
        return scales[splats.rows], rotations[splats.rows]

    @cached_property
    def _lasting_shapes(self) -> tuple[Tensor, Tensor] | None:
        """Those of all Gaussians where they are the same at all times: finding them takes as long as all else."""
        return None if self.moving is None else scales_and_rotations(self.moving.covariances)

    def restricted(self, frames: Sequence[int]) -> Clip:
        """The clip's frames with these numbers."""
        for frame in frames:
            if frame not in self.clip.frames:
                first, last = self.clip.frames[0], self.clip.frames[-1]
                raise D2Error(f"the run has no frame {frame}: it has {first} to {last}; name some of those in --frames")
        chosen = [i for i, frame in enumerate(self.clip.frames) if frame in set(frames)]
        return Clip(
            tuple(self.clip.frames[i] for i in chosen), tuple(self.clip.seconds[i] for i in chosen), self.clip.fps
        )


def scene_of(run: Run, unfinished: bool = False) -> ExportScene:
    """The trained scene of a run.

    Raises:
        D2Error: nothing is trained yet; it is not trained to the end, unless `unfinished`; no Gaussian is left.
    """
    trainer, settings = run.trained(), run.settings
    if trainer.step < settings.iterations and not unfinished:
        raise D2Error(
            f"{run.folder} is at step {trainer.step} of {settings.iterations}: wait for `d2 train` to end, or add "
            "--unfinished to export what is there"
        )
    if not len(trainer.model):
        raise D2Error(f"{run.folder} has no Gaussians: nothing is left to export, train with other settings")
    return scene_of_model(trainer.model, run)


def scene_of_model(model: Any, run: Run) -> ExportScene:
    """A model of the run's backbone with the cameras and the clip of the run."""
    recording = run.scene.recording
    train, test = (
        [recording.cameras[name] for name in names] for names in (run.scene.train_cameras, run.scene.test_cameras)
    )
    clip = Clip(recording.frames, tuple(recording.seconds(frame) for frame in recording.frames), recording.fps)
    view = make_view(recording, train[0].name, recording.frames[0], run.settings.device)
    raster = getattr(getattr(model, "settings", None), "raster", RasterSettings())
    moving = model.moving() if hasattr(model, "moving") else None
    slice_at = slicer(model, view)
    harmonics = _harmonics(model, view)
    return ExportScene(
        recording.name, clip, tuple(train), tuple(test), raster, harmonics, slice_at, moving, background_of(model)
    )


def slicer(model: Any, view: View) -> Callable[[float], Splats]:
    """The model's `slice_at` by time alone."""

    @torch.no_grad()
    def splats_at(time: float) -> Splats:
        return Splats(*(part.detach().cpu() for part in model.slice_at(replace(view, time=time))))

    return splats_at


def _harmonics(model: Any, view: View) -> Harmonics:
    if not hasattr(model, "harmonics"):
        return harmonics_as_seen(model, view)
    own: Harmonics = model.harmonics()
    return own._replace(coefficients=own.coefficients.detach().double().cpu())


@torch.no_grad()
def harmonics_as_seen(model: Any, view: View) -> Harmonics:
    """Of a model that tells none: the colours that one camera sees, for every direction."""
    splats = model.slice_at(view)
    colors = torch.zeros(len(model), 3)
    colors[splats.rows.cpu()] = model.colors(view, splats).detach().cpu()
    return Harmonics(coefficients_from_rgb(colors, 0, 0).double(), 0)


def background_of(model: Any) -> Tensor | None:
    """Spherical harmonics [16, 3] of what lies behind all Gaussians of the model; None where it has none."""
    background = getattr(model, "background", None)
    if background is None:
        return None
    return torch.cat([background.constant, background.harmonics]).detach().double().cpu()

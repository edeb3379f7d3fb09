"""The same recording with fewer cameras, fewer frames or fewer pixels; still read only when asked for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.recordings.images import shrink_depth, shrink_image, shrink_mask
from d2_plugin.recordings.recording import Camera, Recording, Source
from d2_plugin.settings import Downscale
from d2_plugin.values import checked_arguments, fitting

T = TypeVar("T")


@checked_arguments
def select_cameras(recording: Recording, cameras: Iterable[str]) -> Recording:
    """The recording with the named cameras only, in the order given."""
    names = list(cameras)
    if not names:
        raise D2Error(f"no camera chosen from {recording.name}: name at least one of {', '.join(recording.cameras)}")
    refuse_unknown("camera", names, recording.cameras)
    if len(set(names)) < len(names):
        raise D2Error(f"camera names {', '.join(names)} contain a duplicate: name each camera once")
    return replace(recording, cameras={name: recording.cameras[name] for name in names})


@checked_arguments
def select_frames(recording: Recording, frames: Iterable[int]) -> Recording:
    """The recording with the given frame numbers only, ascending."""
    chosen, there = tuple(sorted(set(frames))), set(recording.frames)
    missing = [frame for frame in chosen if frame not in there]
    if missing or not chosen:
        what = f"frame {missing[0]} is not in {recording.name}" if missing else f"no frame chosen from {recording.name}"
        raise D2Error(f"{what}: choose among frames {recording.frames[0]} to {recording.frames[-1]}")
    return replace(recording, frames=chosen)


def spread(items: Sequence[T], most: int) -> list[T]:
    """At most `most` of the items, evenly spread from the first to the last."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def downscale(recording: Recording, factor: int) -> Recording:
    """The recording with every `factor` x `factor` block of pixels made one, and K made to fit.

    Rows and columns that fill no block are cut off at the bottom and on the right, so K / factor is exact with pixel
    centres at i + 0.5. Monocular maps keep the size they are stored in.
    """
    factor = fitting(Downscale, factor, "downscale")
    if factor == 1:
        return recording
    cameras = {name: _smaller_camera(camera, factor) for name, camera in recording.cameras.items()}
    return replace(recording, cameras=cameras, source=DownscaledSource(recording, factor))


@dataclass(frozen=True)
class DownscaledSource(Source):
    """The images and depths of a recording, made smaller by a whole factor after their size was checked."""

    recording: Recording
    factor: int

    def image(self, camera: str, frame: int) -> np.ndarray:
        return shrink_image(self.recording.image(camera, frame), self.factor)

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        depth = self.recording.depth(camera, frame)
        return None if depth is None else shrink_depth(depth, self.factor)

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        return self.recording.mono(camera, frame)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        mask = self.recording.mask(camera, frame)
        return None if mask is None else shrink_mask(mask, self.factor)

    def recorded(self, camera: str) -> np.ndarray | None:
        valid = self.recording.recorded(camera)
        return None if valid is None else shrink_mask(valid.astype(np.float32), self.factor) > 1 - 1e-6


def _smaller_camera(camera: Camera, factor: int) -> Camera:
    width, height = camera.width // factor, camera.height // factor
    if min(width, height) < 1:
        raise D2Error(
            f"downscale {factor} leaves no pixel of camera {camera.name} ({camera.width}x{camera.height}): "
            "choose a smaller factor"
        )
    K = camera.K.copy()
    K[:2] /= factor
    return replace(camera, width=width, height=height, K=K)

"""A synchronized multi-camera recording: cameras, frames, and images that are read when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error, unknown_name

MonoKind = Literal["relative", "metric"]


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated pinhole camera: OpenCV axes, x_cam = R X + t, pixel i has its centre at i + 0.5."""

    name: str
    width: int
    height: int
    K: np.ndarray  # [3, 3] float64, pixels
    T_camera_world: np.ndarray  # [4, 4] float64
    near_far: tuple[float, float] | None = None  # depth range the data set declares, world units

    @property
    def centre(self) -> np.ndarray:
        """Camera centre in the world, [3]."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    def world(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points [..., 3] of pixels [..., 2] at planar depths [...]."""
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1) @ np.linalg.inv(self.K).T
        return (rays * depth[..., None] - self.T_camera_world[:3, 3]) @ self.T_camera_world[:3, :3]

    def calibration(self) -> dict[str, Any]:
        """Size, K and pose as plain values, by which a prior store knows its recording again."""
        K, pose = (np.asarray(matrix, float).tolist() for matrix in (self.K, self.T_camera_world))
        return {"size": [self.width, self.height], "K": K, "T_camera_world": pose}


class Exposure(NamedTuple):
    """How bright a camera sees what others see, per channel: its gain over their geometric mean."""

    gain: tuple[float, float, float]
    error: tuple[float, float, float]  # standard error


class Source:
    """Where images come from; each read opens one file (or decodes one video frame) and keeps nothing.

    A source of its own inherits from this one and has at least `image`.
    """

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        raise NotImplementedError

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z float32 [H, W], 0 where unknown, or None where there is no truth."""
        return None

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """A monocular prediction float32 [h, w] lying on disk, or None."""
        return None

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        """How much each pixel is foreground, float32 [H, W] in 0..1, or None where nothing is known of it."""
        return None

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels were recorded, bool [H, W], or None where all were."""
        return None


@dataclass(frozen=True, eq=False)
class Recording:
    """Cameras, frames and a source of images.

    `frames` are the frame numbers present for every camera, ascending; `fps` converts them to seconds.
    `mono_kind` says what `source.mono` returns: "relative" is affine-invariant inverse depth (larger is nearer),
    "metric" is depth; None when there are no maps. `mono_emulated` is True when those maps were made from true
    depth rather than predicted by a network: whoever shows a figure that rests on them must say so. `layout` names the
    reader in `d2_plugin.recordings.LAYOUTS` that opened it, which camera presets go by. `exposures` are what the import
    of videos measured, by camera; none elsewhere. `late` says by how many seconds a camera's frame was taken after the
    instant that its number stands for, where cameras did not expose together.
    """

    name: str
    cameras: dict[str, Camera]
    frames: tuple[int, ...]
    fps: float
    source: Source
    path: Path | None = None
    mono_kind: MonoKind | None = None
    mono_emulated: bool = False
    notes: tuple[str, ...] = field(default=())
    layout: str = "folder"
    exposures: Mapping[str, Exposure] = field(default_factory=dict)
    late: Mapping[str, Mapping[int, float]] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]; refuses an image whose size is not the camera's."""
        return self._sized(self.source.image(self._known(camera, frame), frame), camera, frame, "frame")

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z float32 [H, W] (0 = unknown), or None; refuses a map whose size is not the camera's."""
        depth = self.source.depth(self._known(camera, frame), frame)
        return None if depth is None else self._sized(depth, camera, frame, "true depth of frame")

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """Monocular map of `mono_kind` from disk, float32 at the size it is stored in, or None."""
        return self.source.mono(self._known(camera, frame), frame)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        """How much each pixel is foreground, float32 [H, W] in 0..1, or None where nobody says."""
        self._known(camera, frame)
        mask = self.source.mask(camera, frame)
        return None if mask is None else self._sized(mask, camera, frame, "mask of frame")

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels were recorded, bool [H, W], or None where all were: undistorting leaves some without."""
        self._known(camera)
        valid = self.source.recorded(camera)
        return None if valid is None else self._sized(valid, camera, self.frames[0], "valid region at frame")

    @property
    def rate(self) -> float:
        """Frames per second of those that are here: of a choice of frames fewer than `fps`."""
        seconds = self.seconds(self.frames[-1])
        return (len(self.frames) - 1) / seconds if seconds > 0 else self.fps

    def seconds(self, frame: int, camera: str | None = None) -> float:
        """Time of a frame since the first one, in seconds; with `camera`, the instant at which that one took it."""
        late = 0.0 if camera is None else self.late.get(camera, {}).get(frame, 0.0)
        return (frame - self.frames[0]) / self.fps + late

    def _sized(self, array: np.ndarray, camera: str, frame: int, what: str) -> np.ndarray:
        expected = (self.cameras[camera].height, self.cameras[camera].width)
        if array.shape[:2] != expected:
            raise D2Error(
                f"{what} {frame} of camera {camera} is {array.shape[1]}x{array.shape[0]} pixels but its calibration "
                f"says {expected[1]}x{expected[0]}: resize the image or correct the camera"
            )
        return array

    def _known(self, camera: str, frame: int = 0) -> str:
        if not isinstance(camera, str) or camera not in self.cameras:
            raise unknown_name("camera", camera, self.cameras)
        if isinstance(frame, bool) or not isinstance(frame, (int, np.integer)):
            raise D2Error(f"frame {frame!r} is no number: choose among frames {self.frames[0]} to {self.frames[-1]}")
        return camera

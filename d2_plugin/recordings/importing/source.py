"""Frames of several videos as one recording: decoded, undistorted, cut and made smaller when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import shown_path
from d2_plugin.recordings.cameras.formats import CalibratedCamera
from d2_plugin.recordings.cameras.lens import UndistortedSource
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.decoding import Decoder
from d2_plugin.recordings.importing.files import Turn, VideoFile
from d2_plugin.recordings.recording import Camera


@dataclass(frozen=True)
class Cut:
    """Which part of an upright, undistorted image is kept, and how large it becomes."""

    left: int
    top: int
    width: int
    height: int
    scale: float = 1.0

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of what it leaves."""
        return max(round(self.width * self.scale), 1), max(round(self.height * self.scale), 1)

    def of(self, image: np.ndarray) -> np.ndarray:
        """The image [H, W, ...], cut and made smaller by averaging."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        if self.size == (self.width, self.height):
            return np.ascontiguousarray(part)
        cv2 = opencv("making images smaller")
        return cv2.resize(part, self.size, interpolation=cv2.INTER_AREA)

    def camera(self, calibrated: CalibratedCamera) -> Camera:
        """The pinhole camera of what is left of the undistorted images of a calibrated camera."""
        whole = calibrated.pinhole()
        moved = np.array([[1.0, 0, -self.left], [0, 1.0, -self.top], [0, 0, 1.0]])
        shrunk = np.diag([self.size[0] / self.width, self.size[1] / self.height, 1.0])
        return replace(whole, width=self.size[0], height=self.size[1], K=shrunk @ moved @ whole.K)

    def check(self, name: str, size: tuple[int, int]) -> None:
        """Refuse a part that lies outside of an image of `size`, or nothing left of it."""
        if min(self.left, self.top) < 0 or self.left + self.width > size[0] or self.top + self.height > size[1]:
            raise D2Error(
                f"--crop {self.width}x{self.height}+{self.left}+{self.top} lies outside of camera {name}, which has "
                f"{size[0]}x{size[1]} pixels: give WIDTHxHEIGHT+LEFT+TOP inside of it"
            )
        if min(self.width * self.scale, self.height * self.scale) < 8:
            raise D2Error(f"--scale {self.scale:g} leaves less than 8 pixels of camera {name}: choose a larger one")


@dataclass(frozen=True)
class Upright:
    """The images as they are decoded."""

    videos: Mapping[str, VideoFile]
    indices: Mapping[str, Mapping[int, int]]
    """By camera, the video's frame of each frame of the recording."""
    _decoders: dict[str, Decoder] = field(default_factory=dict, repr=False, compare=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3], upright."""
        index = self.indices[camera].get(frame)
        if index is None:
            raise D2Error(f"camera {camera} has no frame {frame}: choose one of the recording's frames")
        if camera not in self._decoders:
            self._decoders[camera] = Decoder(self.videos[camera])
        return self._decoders[camera].image(index)

    def depth(self, camera: str, frame: int) -> None:
        """None: a video carries no true depth."""

    def mono(self, camera: str, frame: int) -> None:
        """None: a video carries no monocular maps."""

    def __reduce__(self) -> tuple[Any, ...]:  # another process opens its own decoders
        return Upright, (self.videos, self.indices)


@dataclass(frozen=True)
class VideosSource:
    """The images of a recording that stays in its videos; not for several threads at the same time."""

    upright: Upright
    cameras: Mapping[str, CalibratedCamera]
    cuts: Mapping[str, Cut]
    _straight: UndistortedSource = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        bent = {name: camera.lens for name, camera in self.cameras.items() if camera.lens.bends}
        sizes = {name: (self.cameras[name].width, self.cameras[name].height) for name in bent}
        object.__setattr__(self, "_straight", UndistortedSource(self.upright, bent, sizes))

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]: undistorted, black where nothing was recorded, cut and made smaller."""
        image = self._straight.image(camera, frame)
        expected = self.cameras[camera]
        if image.shape[:2] != (expected.height, expected.width):
            raise D2Error(
                f"frame {frame} of {shown_path(self.upright.videos[camera].path)} is {image.shape[1]}x"
                f"{image.shape[0]} pixels and the first one {expected.width}x{expected.height}: the size changes "
                "within the video, so choose --times of one size"
            )
        return self.cuts[camera].of(image)

    def depth(self, camera: str, frame: int) -> None:
        """None: a video carries no true depth."""

    def mono(self, camera: str, frame: int) -> None:
        """None: a video carries no monocular maps."""

    def mask(self, camera: str, frame: int) -> None:
        """None: a video carries no masks."""

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels [h, w] were recorded, or None where all were."""
        valid = valid_pixels(self.cameras[camera], self.cuts[camera])
        return None if valid.all() else valid

    def as_dict(self) -> dict[str, Any]:
        """Plain values, from which `from_dict` makes the same."""
        return {name: self._camera(name) for name in self.cameras}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], folder: Path) -> VideosSource:
        """What `as_dict` made; paths are relative to `folder` where they are not absolute."""
        videos, indices, cameras, cuts = {}, {}, {}, {}
        for name, entry in table.items():
            video = VideoFile.from_dict(entry["video"])
            videos[name] = replace(video, path=folder / video.path)
            indices[name] = dict(zip(entry["frames"], entry["places"]))
            lens = {key: np.array(entry[key], np.float64) for key in ("matrix", "rotation", "translation")}
            width, height = videos[name].turn.size(*video.size)
            cameras[name] = CalibratedCamera(
                name, width, height, model=entry["model"], distortion=tuple(entry["distortion"]), **lens
            )
            cuts[name] = Cut(**entry["cut"])
        return cls(Upright(videos, indices), cameras, cuts)

    def _camera(self, name: str) -> dict[str, Any]:
        camera, cut, places = self.cameras[name], self.cuts[name], self.upright.indices[name]
        lens = {key: getattr(camera, key).tolist() for key in ("matrix", "rotation", "translation")}
        return {
            "video": self.upright.videos[name].as_dict(),
            "frames": list(places),
            "places": list(places.values()),
            "cut": {key: getattr(cut, key) for key in ("left", "top", "width", "height", "scale")},
            "model": camera.model,
            "distortion": list(camera.distortion),
            **lens,
        }


def valid_pixels(camera: CalibratedCamera, cut: Cut) -> np.ndarray:
    """Which pixels of what is left [h, w] were recorded by the camera, bool."""
    small = cut.camera(camera)
    columns, rows = (np.arange(length) + 0.5 for length in (small.width, small.height))
    x, y = np.meshgrid(columns / small.width * cut.width + cut.left, rows / small.height * cut.height + cut.top)
    recorded = camera.lens.recorded_pixels(np.stack([x, y], axis=-1))
    with np.errstate(invalid="ignore"):
        inside = ((recorded >= 0.5) & (recorded <= np.array([camera.width, camera.height]) - 0.5)).all(axis=-1)
    return np.asarray(inside)


def unturned(video: VideoFile) -> VideoFile:
    """The video as it is stored: for a calibration that was made of stored images."""
    return replace(video, turn=Turn(0))

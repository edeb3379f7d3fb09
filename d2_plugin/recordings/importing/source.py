"""Frames of several videos as one recording: decoded, undistorted, cut and made smaller when asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import shown_path
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.formats.cameras_json import camera_table, read_camera
from d2_plugin.recordings.cameras.undistort import UndistortedSource
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.settings import ImportChoices, by_camera
from d2_plugin.recordings.importing.video import VideoFile, VideoFrames, decoded_alone
from d2_plugin.recordings.recording import Camera, Recording, Source
from d2_plugin.recordings.selection import spread

MOMENTS = 6  # images of each camera that are checked, spread over the recording: decoding them is most of an import
LONG_SIDE = 640  # pixels of the longer side of these, at most


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
        if self.left + self.width > size[0] or self.top + self.height > size[1]:
            raise D2Error(
                f"--crop {self.width}x{self.height}+{self.left}+{self.top} lies outside of camera {name}, which has "
                f"{size[0]}x{size[1]} pixels: give WIDTHxHEIGHT+LEFT+TOP inside of it"
            )
        if min(self.width * self.scale, self.height * self.scale) < 8:
            why = f"--scale {self.scale:g} of {self.width}x{self.height} pixels"
            raise D2Error(f"{why} leaves less than 8 of camera {name} along a side: keep more of it")


def cuts_of(choices: ImportChoices, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Cut]:
    """What is kept of the images of each camera, whose images have `sizes`.

    Raises:
        D2Error: a part that is not written WIDTHxHEIGHT+LEFT+TOP, lies outside of the image or is of no camera.
    """
    cuts = {name: Cut(0, 0, *size, choices.scale) for name, size in sizes.items()}

    def part(text: str) -> Cut | None:
        match = re.fullmatch(r"(\d{1,6})x(\d{1,6})\+(\d{1,6})\+(\d{1,6})", text)
        if match is None:
            return None
        width, height, left, top = map(int, match.groups())
        return Cut(left, top, width, height, choices.scale)

    cuts |= by_camera("--crop", choices.crop, sizes, part, "WIDTHxHEIGHT+LEFT+TOP such as 1280x720+0+100")
    for name, cut in cuts.items():
        cut.check(name, sizes[name])
    return cuts


@dataclass(frozen=True)
class KeptImages(Source):
    """Images in memory."""

    images: Mapping[str, Mapping[int, np.ndarray]]  # by camera and frame

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self.images[camera][frame]


@dataclass(frozen=True)
class VideosSource(Source):
    """The images of a recording that stays in its videos; not for several threads at the same time."""

    videos: Mapping[str, VideoFile]
    indices: Mapping[str, Mapping[int, int]]  # by camera, the video's frame of each frame of the recording
    cameras: Mapping[str, CalibratedCamera]
    cuts: Mapping[str, Cut]
    _undistorted: UndistortedSource = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        bent = {name: camera for name, camera in self.cameras.items() if camera.lens.bends}
        object.__setattr__(self, "_undistorted", UndistortedSource(VideoFrames(self.videos, self.indices), bent))

    def pinholes(self) -> dict[str, Camera]:
        """The cameras of the images that it gives."""
        return {name: self.cuts[name].camera(camera) for name, camera in self.cameras.items()}

    def image(self, camera: str, frame: int) -> np.ndarray:
        image = self._undistorted.image(camera, frame)
        expected = self.cameras[camera]
        if image.shape[:2] != (expected.height, expected.width):
            raise D2Error(
                f"frame {frame} of {shown_path(self.videos[camera].path)} is {image.shape[1]}x"
                f"{image.shape[0]} pixels and the first one {expected.width}x{expected.height}: the size changes "
                "within the video, so choose --times of one size"
            )
        return self.cuts[camera].of(image)

    def checked(self, recording: Recording) -> Recording:
        """Smaller images of some moments of a recording out of here, decoded once for all that is checked on them."""
        smaller = {name: min(LONG_SIDE / max(cut.size), 1) for name, cut in self.cuts.items()}
        cuts = {name: replace(cut, scale=cut.scale * smaller[name]) for name, cut in self.cuts.items()}
        source, frames = replace(self, cuts=cuts), self._moments(recording.frames)
        images = {name: {frame: source.image(name, frame) for frame in frames} for name in cuts}
        return replace(recording, cameras=source.pinholes(), frames=frames, source=KeptImages(images))

    def _moments(self, frames: Sequence[int]) -> tuple[int, ...]:
        """The first, the last, and evenly spread ones between, each moved a little to where least must be decoded."""
        places, reach = spread(range(len(frames)), MOMENTS), len(frames) // (2 * MOMENTS)

        def before(place: int) -> int:
            own = ((self.videos[name], indices[frames[place]]) for name, indices in self.indices.items())
            return sum(index - decoded_alone(video, index) for video, index in own)

        places[1:-1] = [min((k, *range(k - reach, k + reach + 1)), key=before) for k in places[1:-1]]
        return tuple(frames[place] for place in places)

    def recorded(self, camera: str) -> np.ndarray | None:
        whole = self._undistorted.recorded(camera)
        if whole is None:
            return None
        valid = self.cuts[camera].of(whole.astype(np.float32)) > 0.99
        return None if valid.all() else valid

    def as_dict(self) -> dict[str, Any]:
        """Plain values, from which `from_dict` makes the same."""
        return {
            name: {
                "video": self.videos[name].as_dict(),
                "frames": list(self.indices[name]),
                "places": list(self.indices[name].values()),
                "cut": asdict(self.cuts[name]),
                "camera": camera_table(camera),
            }
            for name, camera in self.cameras.items()
        }

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], folder: Path) -> VideosSource:
        """What `as_dict` made; paths are relative to `folder` where they are not absolute."""
        videos = {name: VideoFile.from_dict(entry["video"]) for name, entry in table.items()}
        return cls(
            {name: replace(video, path=folder / video.path) for name, video in videos.items()},
            {name: dict(zip(entry["frames"], entry["places"])) for name, entry in table.items()},
            {name: read_camera(entry["camera"], str(folder)) for name, entry in table.items()},
            {name: Cut(**entry["cut"]) for name, entry in table.items()},
        )

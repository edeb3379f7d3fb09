"""What `d2 render` takes, and a video before it is drawn: where the camera stands at each image, and which instant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error, refuse_unknown, unknown_name
from d2_plugin.recordings import Camera
from d2_plugin.settings import Downscale, Positional, Range, Settings
from d2_plugin.viewing.camera_paths import orbit, read_camera_path
from d2_plugin.viewing.panels import RECORDED
from d2_plugin.viewing.videos.video import RATES, Format
from d2_plugin.viewing.viewed import ViewedRun

STANDING = ("held-out", "training")
"""Paths by name, as is orbit; anything else is the path of a file."""
MOVING_SECONDS = 6.0
"""Length of a video whose camera moves, where the recording is shorter."""
MOST_IMAGES = 1_000_000
"""Of a video: nine hours at 30 per second."""


@dataclass(frozen=True)
class RenderSettings(Settings):
    """What is shown, from where, when, and how it is written."""

    runs: Annotated[tuple[Path, ...], Positional()]
    """Folders of `d2 train`, shown beside each other; or checkpoints of official trainers, with --recording."""
    output: Path | None = None
    """File of the video, or folder of its PNGs; by default in videos/ of the first run."""
    path: str = "held-out"
    """Where the camera stands: held-out (each held-out camera in turn), training (each training camera), or where it
    moves: orbit, or a camera_path.json of `d2 view`."""
    show: tuple[str, ...] = ("rgb",)
    """Images beside each other, joined by commas: rgb, depth, alpha; at the recording's cameras also truth, error,
    true-depth."""
    cameras: tuple[str, ...] | None = None
    """Cameras of the path; by default all held-out or all training cameras."""
    at: Annotated[float, Range(0, 1e6, unit="seconds")] | None = None
    """Freeze time at this instant while the camera moves."""
    speed: Annotated[float, Range(1e-6, 1e6)] = 1.0
    """Of time in the recording: 0.25 is slow motion, with images between the recorded frames."""
    seconds: Annotated[float, Range(1e-3, 1e6, unit="seconds")] | None = None
    """Length of the video, for each camera where it stands; by default that of the recording, and at least 6 where the
    camera moves. Time runs back and forth in a video that is longer than the recording."""
    fps: Annotated[float, Range(*RATES, unit="images per second")] | None = None
    """Of the video; by default those of the recording."""
    degrees: Annotated[float, Range(0.01, 360, unit="degrees")] | None = None
    """Angle that an orbit swings; by default what the training cameras span: the rest was not recorded."""
    width: Annotated[int, Range(1, 16384, unit="pixels")] | None = None
    """Width of each image; by default the camera's."""
    height: Annotated[int, Range(1, 16384, unit="pixels")] | None = None
    """Height of each image; by default the camera's, or in proportion to the width."""
    format: Format = "mp4"
    """mp4 (H.264 that browsers play), webp (animated, in a loop), png (one file per image)."""
    quality: Annotated[int, Range(0, 51)] = 18
    """Constant rate factor of mp4, 0 is lossless; the quality of webp is 100 less twice this."""
    no_captions: bool = False
    """Leave out the line above images that says what they are."""
    recording: Path | None = None
    """The recording of a checkpoint of an official trainer."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with; all but these are held out."""
    downscale: Downscale = 1
    """For such a checkpoint: make the recording's images this many times smaller."""

    @property
    def recorded(self) -> list[str]:
        """The images among `show` that exist at the recording's cameras and instants only."""
        return [name for name in self.show if name in RECORDED]


class Stop(NamedTuple):
    """One image of a video."""

    camera: Camera
    time: float
    """Seconds since the first frame."""


class Plan(NamedTuple):
    """All images of a video, in order."""

    stops: list[Stop]
    fps: float


def plan_video(viewed: ViewedRun, settings: RenderSettings) -> Plan:
    """Lay out a video.

    Time runs forward at `speed` and bounces at the ends of the recording where the video is longer; `at` freezes it.
    Where images are compared with the recording, each shows the recorded instant that is nearest.

    Raises:
        D2Error: an unknown path or camera, no camera to stand at, or an instant outside the recording.
    """
    if settings.at is not None and not 0 <= settings.at <= viewed.duration + 1e-9:
        raise D2Error(f"--at {settings.at:g} s lies outside the recording, which lasts {viewed.duration:g} s")
    fps = settings.fps or viewed.recording.fps
    if settings.path in STANDING:
        stops = _standing(viewed, settings, fps)
    elif settings.path == "orbit":
        stops = _orbiting(viewed, settings, fps)
    else:
        stops, fps = _from_file(viewed, settings)
    if settings.recorded:
        seconds, at = viewed.recording.seconds, viewed.frame_at
        stops = [Stop(camera, seconds(at(time, camera.name), camera.name)) for camera, time in stops]
    return Plan(stops, fps)


def _instants(viewed: ViewedRun, settings: RenderSettings, count: int, fps: float) -> list[float]:
    """Seconds of `count` images: frozen, or forward and back again."""
    if settings.at is not None:
        return [settings.at] * count
    duration = viewed.duration
    if duration == 0:
        return [0.0] * count
    run = np.arange(count) * settings.speed / fps
    bounced = duration - np.abs(np.mod(run, 2 * duration) - duration)
    # The last image of a video as long as the recording shows its last frame, not a rounding error after it.
    return [float(np.clip(time, 0, duration)) for time in bounced]


def _standing(viewed: ViewedRun, settings: RenderSettings, fps: float) -> list[Stop]:
    of_path, others = viewed.test_cameras, viewed.train_cameras
    if settings.path == "training":
        of_path, others = others, of_path
    names = settings.cameras or of_path
    refuse_unknown("camera", names, viewed.recording.cameras)
    if wrong := [name for name in names if name in others and name not in of_path]:
        right = "training" if settings.path == "held-out" else "held-out"
        raise D2Error(f"camera {wrong[0]} is a {right} one: choose --path {right}, or other --cameras")
    if not names:
        raise D2Error(f"{viewed.name} has no held-out camera: choose --path training or orbit")
    if settings.seconds is not None:
        count = _count(settings.seconds * fps, 1)
    elif settings.at is None and viewed.duration > 0:
        count = _count(viewed.duration / settings.speed * fps + 0.5 + 1e-6, 1)  # one more than intervals fit
    else:
        count = _count(fps, 1)
    times = _instants(viewed, settings, count, fps)
    return [Stop(viewed.recording.cameras[name], time) for name in names for time in times]


def _orbiting(viewed: ViewedRun, settings: RenderSettings, fps: float) -> list[Stop]:
    names = settings.cameras or viewed.train_cameras
    refuse_unknown("camera", names, viewed.recording.cameras)
    cameras = [viewed.recording.cameras[name] for name in names]
    played = 0 if settings.at is not None else viewed.duration / settings.speed
    count = _count((settings.seconds or max(MOVING_SECONDS, played)) * fps, 2)
    path = orbit(cameras, count, settings.degrees, viewed.depth)
    return [Stop(camera, time) for camera, time in zip(path, _instants(viewed, settings, count, fps), strict=True)]


def _from_file(viewed: ViewedRun, settings: RenderSettings) -> tuple[list[Stop], float]:
    if not settings.path.endswith(".json"):
        raise unknown_name("camera path", settings.path, [*STANDING, "orbit", "FILE.json"])
    path = read_camera_path(Path(settings.path))
    fps = settings.fps or (len(path.cameras) / settings.seconds if settings.seconds else path.fps)
    if path.shares is not None and settings.at is None:
        times = [share * viewed.duration for share in path.shares]
    else:
        times = _instants(viewed, settings, len(path.cameras), fps)
    return [Stop(camera, time) for camera, time in zip(path.cameras, times, strict=True)], fps


def _count(images: float, least: int) -> int:
    """How many images a video has, where that is no more than one may have."""
    if not images <= MOST_IMAGES:
        raise D2Error(
            f"the video would have {images:.3g} images, at most {MOST_IMAGES}: choose fewer --seconds, a lower "
            "--fps or a higher --speed"
        )
    return max(round(images), least)

"""A video before it is drawn: where the camera stands at each image, and which instant it shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.viewing.paths import Pose, orbit, pose_of, spiral, through
from d2_plugin.viewing.subject import Subject
from d2_plugin.viewing.videos.path_file import read_camera_path
from d2_plugin.viewing.videos.video import RATES

STANDING = ("held-out", "training")
MOVING = ("orbit", "spiral", "through")
"""Paths by name; anything else is the path of a file."""
MOVING_SECONDS = 6.0
"""Length of a video whose camera moves, where the recording is shorter."""
MOST_IMAGES = 1_000_000
"""Of a video: nine hours at 30 per second."""


class Stop(NamedTuple):
    """One image of a video."""

    pose: Pose
    time: float
    """Seconds since the first frame."""
    camera: str = ""
    """The camera of the recording that stands there, if one does."""


@dataclass(frozen=True)
class Wishes:
    """What a video should show; None is the default of the path."""

    path: str = "held-out"
    cameras: tuple[str, ...] | None = None
    at: float | None = None
    speed: float = 1.0
    seconds: float | None = None
    fps: float | None = None
    degrees: float | None = None
    recorded_instants: bool = False
    """Show the recorded instant that is nearest to each: where images are held against the truth."""


class Plan(NamedTuple):
    """All images of a video, in order."""

    stops: list[Stop]
    fps: float


def plan_video(subject: Subject, wishes: Wishes) -> Plan:
    """Lay out a video.

    Time runs forward at `speed` and bounces at the ends of the recording where the video is longer; `at` freezes it.

    Raises:
        D2Error: an unknown path or camera, no camera to stand at, or an instant outside the recording.
    """
    if wishes.at is not None and not 0 <= wishes.at <= subject.duration + 1e-9:
        raise D2Error(f"--at {wishes.at:g} s lies outside the recording, which lasts {subject.duration:g} s")
    fps = _checked_rate(wishes.fps or subject.recording.fps)
    if wishes.path in STANDING:
        stops = _standing(subject, wishes, fps)
    elif wishes.path in MOVING:
        stops = _moving(subject, wishes, fps)
    else:
        stops, fps = _from_file(subject, wishes)
    if wishes.recorded_instants:
        recording = subject.recording
        stops = [stop._replace(time=recording.seconds(subject.frame_at(stop.time))) for stop in stops]
    return Plan(stops, fps)


def instants(subject: Subject, wishes: Wishes, count: int, fps: float) -> list[float]:
    """Seconds of `count` images: frozen, or forward and back again."""
    if wishes.at is not None:
        return [wishes.at] * count
    duration = subject.duration
    if duration == 0:
        return [0.0] * count
    run = np.arange(count) * wishes.speed / fps
    bounced = duration - np.abs(np.mod(run, 2 * duration) - duration)
    # The last image of a video as long as the recording shows its last frame, not a rounding error after it.
    return [float(np.clip(time, 0, duration)) for time in bounced]


def _standing(subject: Subject, wishes: Wishes, fps: float) -> list[Stop]:
    """Each of the cameras in turn, the whole recording at each."""
    of_path = subject.test_cameras if wishes.path == "held-out" else subject.train_cameras
    names = wishes.cameras or of_path
    if not names:
        raise D2Error(f"{subject.name} has no held-out camera: choose --path training, through, orbit or spiral")
    known = _known(subject, names)
    seconds = wishes.seconds
    if seconds is None:
        moves = wishes.at is None and subject.duration > 0
        count = math.floor(_bounded(subject.duration / wishes.speed * fps) + 1e-6) + 1 if moves else max(round(fps), 1)
    else:
        count = max(round(_bounded(seconds * fps)), 1)
    times = instants(subject, wishes, count, fps)
    return [Stop(pose_of(subject.recording.cameras[name]), time, name) for name in known for time in times]


def _moving(subject: Subject, wishes: Wishes, fps: float) -> list[Stop]:
    names = _known(subject, wishes.cameras or subject.train_cameras)
    cameras = [subject.recording.cameras[name] for name in names]
    seconds = wishes.seconds or max(MOVING_SECONDS, 0 if wishes.at is not None else subject.duration / wishes.speed)
    count = max(round(_bounded(seconds * fps)), 2)
    if wishes.path == "orbit":
        poses = orbit(cameras, count, wishes.degrees, subject.depth)
    elif wishes.path == "spiral":
        poses = spiral(cameras, count, subject.depth)
    else:
        poses = through(cameras, count)
    return [Stop(pose, time) for pose, time in zip(poses, instants(subject, wishes, count, fps), strict=True)]


def _from_file(subject: Subject, wishes: Wishes) -> tuple[list[Stop], float]:
    if not wishes.path.endswith(".json"):
        raise unknown_name("camera path", wishes.path, [*STANDING, *MOVING, "FILE.json"])
    found = read_camera_path(Path(wishes.path))
    fps = _checked_rate(wishes.fps or found.fps)
    if found.shares is not None and wishes.at is None:
        times = [share * subject.duration for share in found.shares]
    else:
        times = instants(subject, wishes, len(found.poses), fps)
    return [Stop(pose, time) for pose, time in zip(found.poses, times, strict=True)], fps


def _checked_rate(fps: float) -> float:
    if not RATES[0] <= fps <= RATES[1]:
        raise D2Error(
            f"a video of {fps:g} images per second cannot be written: give --fps from {RATES[0]:g} to {RATES[1]:g}"
        )
    return fps


def _bounded(images: float) -> float:
    """How many images a video would have, where that is no more than one may have."""
    if not images <= MOST_IMAGES:
        raise D2Error(
            f"the video would have {images:.3g} images, at most {MOST_IMAGES}: choose fewer --seconds, a lower "
            "--fps or a higher --speed"
        )
    return images


def _known(subject: Subject, names: Sequence[str]) -> Sequence[str]:
    for name in names:
        if name not in subject.recording.cameras:
            raise unknown_name("camera", name, subject.recording.cameras)
    return names

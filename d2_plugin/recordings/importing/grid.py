"""Frames of a recording out of videos on one clock: for each instant the image of every camera that is nearest.

Nothing is interpolated: an image keeps the instant at which it was taken, and `late` says how far that is from the
instant that its frame number stands for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.importing.clocks import Clock
from d2_plugin.recordings.importing.video import VideoFile, usual_rate

REACH = 0.75
"""An image farther than this many frames of the recording, or half of the camera's own, stands for no instant."""

TOGETHER = 1e-4  # seconds: cameras that are late by no more exposed together


@dataclass(frozen=True)
class Grid:
    """Which frame of which video is which frame of the recording."""

    rate: float  # frames of the recording per second
    indices: dict[str, dict[int, int]]  # by camera: frame of the recording -> frame of the video
    late: dict[str, dict[int, float]]  # by camera and frame, seconds; empty where all exposed together
    notes: tuple[str, ...] = ()


def grid_of(
    videos: Mapping[str, VideoFile],
    clocks: Mapping[str, Clock],
    rate: float | None = None,
    times: Sequence[float] | None = None,
    frames: Sequence[int] | None = None,
) -> Grid:
    """The frames that all cameras have, at `rate` per second or that of the slowest camera.

    Frame 0 is the first image of the first camera that all others have too.

    Args:
        videos: at least one.
        clocks: when each began.
        rate: frames per second.
        times: (first, last) seconds of the recording to take.
        frames: numbers to take.

    Raises:
        D2Error: no instant at which all cameras recorded, or none of those that were asked for.
    """
    taken = {name: clocks[name].seconds + video.times for name, video in videos.items()}
    begin, end = max(one[0] for one in taken.values()), min(one[-1] for one in taken.values())
    fps = rate or usual_rate(min((video.rate for video in videos.values() if video.rate), default=25.0))
    if end < begin - REACH / fps:
        last, early = max(taken, key=lambda name: taken[name][0]), min(taken, key=lambda name: taken[name][-1])
        raise D2Error(
            f"camera {early} stopped {begin - end:.2f} seconds before camera {last} began: leave one out, or correct "
            "--offsets"
        )
    first = taken[next(iter(videos))]
    begin = float(first[np.searchsorted(first, begin - 0.5 / fps).clip(0, len(first) - 1)])
    numbers = np.arange(max(int(np.floor((end - begin) * fps + 0.5 + 1e-6)), 0) + 1)
    numbers = _asked(numbers, fps, times, frames)
    near = {name: _nearest(one, begin + numbers / fps) for name, one in taken.items()}
    kept = np.ones(len(numbers), bool)
    for name, (_, off) in near.items():
        reach = max(REACH / fps, 0.51 / (videos[name].rate or fps))
        kept &= np.abs(off) <= reach
    if not kept.any():
        raise D2Error("no instant is in all videos: correct --offsets, or choose other --times")
    frames = numbers[kept].tolist()
    indices = {name: dict(zip(frames, place[kept].tolist())) for name, (place, _) in near.items()}
    together = all(np.abs(off[kept]).max() <= TOGETHER for _, off in near.values())
    late = {name: dict(zip(frames, off[kept].round(6).tolist())) for name, (_, off) in near.items()}
    return Grid(fps, indices, {} if together else late, _notes(kept, videos, fps))


def _asked(numbers: np.ndarray, fps: float, times: Sequence[float] | None, frames: Sequence[int] | None) -> np.ndarray:
    last = len(numbers) - 1
    if times is not None:
        if len(times) != 2 or not times[0] <= times[1]:
            raise D2Error("--times must be FIRST,LAST in seconds of the recording, such as 0.5,3: correct it")
        numbers = numbers[(numbers / fps >= times[0] - 1e-9) & (numbers / fps <= times[1] + 1e-9)]
        if not len(numbers):
            raise D2Error(
                f"--times asks for {times[0]:g} to {times[1]:g} seconds and the videos share 0 to {last / fps:.2f}: "
                "choose within that"
            )
    if frames is not None:
        missing = sorted(set(frames) - set(numbers.tolist()))
        if missing:
            raise D2Error(
                f"--frames asks for {missing[0]} and the cameras have {numbers[0]} to {numbers[-1]} in common: choose "
                "within that"
            )
        numbers = np.array(sorted(set(frames)))
    return numbers


def _nearest(taken: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(place in `taken` that is nearest to each wanted instant, how much later it is)."""
    after = np.searchsorted(taken, wanted).clip(0, len(taken) - 1)
    before = np.maximum(after - 1, 0)
    place = np.where(np.abs(taken[before] - wanted) <= np.abs(taken[after] - wanted), before, after)
    return place, taken[place] - wanted


def _notes(kept: np.ndarray, videos: Mapping[str, VideoFile], fps: float) -> tuple[str, ...]:
    notes = []
    if not kept.all():
        notes.append(f"{(~kept).sum()} of {len(kept)} frames left out, which some camera dropped")
    slower = [name for name, video in videos.items() if video.rate and video.rate < 0.99 * fps]
    if slower:
        notes.append(f"{', '.join(slower)} recorded fewer than {fps:g} frames per second, so images repeat")
    return tuple(notes)

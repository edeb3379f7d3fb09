"""What a video file says about itself: when each frame is shown, how it is turned, whether it has sound and timecode.

Times are those of the container, so a variable frame rate is honoured; frame numbers times a rate would not be. The
file is walked through once without decoding more than one frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import import_av
from d2_plugin.reading import parsing, said, shown_path
from d2_plugin.recordings.images import MOST_PIXELS
from d2_plugin.recordings.importing.plain import check_container

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".360", ".lrv")
"""Endings by which a folder's videos are found."""

REMEDY = "replace the file or leave its camera out"

UNSTEADY = 0.1
"""Frames whose distance differs from the median by more than this share of it are of a variable rate."""

MOST_FRAMES = 10_000_000
"""A video that has more is damaged: this many are four days at 30 per second."""


class Turn(NamedTuple):
    """How a stored image becomes an upright one."""

    degrees: int
    """0, 90, 180 or 270, counter-clockwise."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) after the turn."""
        return (height, width) if self.degrees % 180 else (width, height)

    def of(self, image: np.ndarray) -> np.ndarray:
        """The image [H, W, ...], turned."""
        return np.ascontiguousarray(np.rot90(image, self.degrees // 90)) if self.degrees else image


@dataclass(frozen=True, eq=False)
class VideoFile:
    """One video as its container describes it."""

    path: Path
    size: tuple[int, int]
    """(width, height) in pixels as stored, before the turn."""
    turn: Turn
    stamps: np.ndarray
    """[N] int64, ascending: when each frame is shown, in units of `unit`."""
    unit: Fraction
    """Seconds."""
    timecode: str | None = None
    sound: bool = False

    @property
    def times(self) -> np.ndarray:
        """[N] seconds on the clock of the file, which the sound shares."""
        return self.stamps * float(self.unit)

    @property
    def rate(self) -> float:
        """Frames per second, those that were dropped counted as well; 0 for a single frame."""
        if len(self.stamps) < 2:
            return 0.0
        steps = np.diff(self.stamps)
        # The whole length, since the median of stamps that are rounded to whole units is rounded itself.
        return float(np.maximum(np.rint(steps / np.median(steps)), 1).sum() / (steps.sum() * float(self.unit)))

    @property
    def unsteady(self) -> bool:
        """Whether the frame rate varies."""
        steps = np.diff(self.times)
        return bool(len(steps) and np.abs(steps - np.median(steps)).max() > UNSTEADY * np.median(steps))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, from which `from_dict` makes the same."""
        kept = {"path": str(self.path), "size": list(self.size), "turn": self.turn.degrees, "sound": self.sound}
        unit = [self.unit.numerator, self.unit.denominator]
        return {**kept, "timecode": self.timecode, "unit": unit, "stamps": self.stamps.tolist()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> VideoFile:
        """What `as_dict` made."""
        stamps = np.array(table["stamps"], np.int64)
        size = (table["size"][0], table["size"][1])
        turn, unit = Turn(table["turn"]), Fraction(*table["unit"])
        return cls(Path(table["path"]), size, turn, stamps, unit, table["timecode"], table["sound"])


def pyav() -> ModuleType:
    """The module av."""
    return import_av("reading videos with their time stamps")


@contextmanager
def container_of(path: Path) -> Iterator[Any]:
    """The opened file; whatever FFmpeg says against it becomes one sentence."""
    av = pyav()
    check_container(path)
    with parsing(f"video {shown_path(path)}", REMEDY), av.open(str(path)) as container:
        yield container


def read_video(path: Path) -> VideoFile:
    """Sizes, time stamps, turn, timecode and sound of a video.

    Raises:
        D2Error: no video, no frame, a first frame that cannot be decoded, or sizes that no video has.
    """
    with container_of(path) as container:
        if not container.streams.video:
            kinds = " and ".join(sorted({stream.type for stream in container.streams})) or "nothing"
            raise D2Error(f"{shown_path(path)} holds {kinds} and no image: give a video of the camera")
        stream = container.streams.video[0]
        stamps, unit = _stamps(container, stream, path), stream.time_base
        timecode = _timecode(container)
        sound = bool(container.streams.audio)
    size, turn = _first_frame(path)
    return VideoFile(path, size, turn, stamps, Fraction(unit), timecode, sound)


def videos_below(folder: Path) -> tuple[Path, ...]:
    """The videos directly in a folder, sorted by name."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    return tuple(path for path in found if not path.name.startswith("."))


def _stamps(container: Any, stream: Any, path: Path) -> np.ndarray:
    """When each frame is shown; frames that an edit list leaves out are none."""
    found: set[int] = set()
    for packet in container.demux(stream):
        stamp = packet.dts if packet.pts is None else packet.pts
        if stamp is not None and packet.size and not packet.is_discard:
            found.add(stamp)
        if len(found) > MOST_FRAMES:
            raise D2Error(f"video {shown_path(path)} has more than {MOST_FRAMES} frames: {REMEDY}")
    if not found:
        raise D2Error(f"video {shown_path(path)} has no frame: {REMEDY}")
    return np.array(sorted(found), np.int64)


def _first_frame(path: Path) -> tuple[tuple[int, int], Turn]:
    """Size and turn of the images, from the first one."""
    with container_of(path) as container:
        try:
            frame = next(container.decode(video=0))
        except StopIteration:
            raise D2Error(f"no frame of video {shown_path(path)} can be decoded: {REMEDY}") from None
        except pyav().error.FFmpegError as failure:
            raise D2Error(f"no frame of video {shown_path(path)} can be decoded ({said(failure)}): {REMEDY}") from None
        if not 0 < frame.width * frame.height <= MOST_PIXELS:
            raise D2Error(
                f"video {shown_path(path)} has images of {frame.width}x{frame.height} pixels, at most {MOST_PIXELS}: "
                f"{REMEDY}"
            )
        quarter = round(float(frame.rotation) / 90)
        return (frame.width, frame.height), Turn(90 * (quarter % 4))


def _timecode(container: Any) -> str | None:
    """The first frame's timecode, wherever the file keeps it."""
    places = [container, *container.streams.video, *container.streams]
    return next((place.metadata["timecode"] for place in places if "timecode" in place.metadata), None)

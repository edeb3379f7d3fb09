"""A video: what its container says about it, and its images by their time stamps, decoded when asked for (PyAV).

Times are those of the container, so a variable frame rate is honoured; frame numbers times a rate would not be. The
file is walked through once without decoding more than one frame; AVI, which says no more than the order of decoding, is
decoded once, and its frames are counted.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import import_av
from d2_plugin.reading import opened, parsing, said, shown_path
from d2_plugin.recordings.images import MOST_PIXELS
from d2_plugin.recordings.recording import Source

VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".360", ".lrv", ".ts"),
)
"""Endings by which a folder's videos are listed."""

BT709 = 1  # FFmpeg's number of the transfer function and of the primaries of SDR

HDR, WIDE = {16: "PQ", 18: "HLG"}, {9: "BT.2020"}  # the same of what HDR has
NOT_READ = (".gif", ".sdp", ".m3u8", ".wmv", ".flv", ".ogv", ".3gp", ".vob", ".mxf", ".h264", ".hevc", ".r3d", ".braw")
"""Endings of videos that no reader here opens."""

_log = logging.getLogger(__name__)

MOST_FRAMES = 10_000_000  # A video that has more is damaged: this many are four days at 30 per second

OPENING = {"format_whitelist": "mov,matroska,webm,avi,mpeg,mpegts,mpegvideo", "protocol_whitelist": "file"}
"""Options of FFmpeg, which else follows playlists and scripts to other files and addresses."""


@dataclass(frozen=True, eq=False)
class VideoFile:
    """One video as its container describes it."""

    path: Path
    stored_size: tuple[int, int]  # (width, height) in pixels before the turn
    turn: int  # how a stored image becomes an upright one: 0, 90, 180 or 270 degrees, counter-clockwise
    stamps: np.ndarray  # [N] int64, ascending: when each frame is shown, in units of `unit`
    unit: Fraction  # seconds
    timecode: str | None = None
    sound: bool = False
    counted: bool = False  # frames are found by their order, since what the container says of their times has none
    keys: tuple[int, ...] = ()  # frames that need no other one, ascending, as the container knows them
    stretched: float = 1.0  # how many times as wide as high a stored pixel is
    interlaced: bool = False  # whether a frame is two half images, taken one after the other
    begin: float = 0.0  # seconds on the clock of an MPEG stream at which the file begins, see `begin_of`
    hdr: str = ""  # how its colours are coded where that is no BT.709, such as "PQ, BT.2020"; they are converted

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the upright images."""
        width, height = self.stored_size
        return (height, width) if self.turn % 180 else (width, height)

    def upright(self, stored: np.ndarray) -> np.ndarray:
        """A stored image [H, W, ...], turned."""
        return np.ascontiguousarray(np.rot90(stored, self.turn // 90)) if self.turn else stored

    @property
    def times(self) -> np.ndarray:
        """[N] seconds on the clock of the file, which the sound shares."""
        return self.stamps * float(self.unit) - self.begin

    @property
    def rate(self) -> float:
        """Frames per second, those that were dropped counted as well; 0 for a single frame."""
        if len(self.stamps) < 2:
            return 0.0
        steps = np.diff(self.stamps)
        # The whole length, since the median of stamps that are rounded to whole units is rounded itself.
        return float(np.maximum(np.rint(steps / np.median(steps)), 1).sum() / (steps.sum() * float(self.unit)))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, from which `from_dict` makes the same."""
        unit = [self.unit.numerator, self.unit.denominator]
        return {**vars(self), "path": str(self.path), "unit": unit, "stamps": self.stamps.tolist()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> VideoFile:
        """What `as_dict` made."""
        arrays = {"stamps": np.array(table["stamps"], np.int64), "stored_size": tuple(table["stored_size"])}
        keys = tuple(table.get("keys", ()))
        return cls(**{**table, **arrays, "keys": keys, "path": Path(table["path"]), "unit": Fraction(*table["unit"])})


def _remedy(path: Path) -> str:
    return f"replace the file or leave camera {path.stem} out"


def pyav() -> ModuleType:
    """The module av."""
    return import_av("reading videos with their time stamps")


@contextmanager
def container_of(path: Path) -> Iterator[Any]:
    """The opened file; whatever FFmpeg says against it becomes one sentence."""
    with parsing(f"video {shown_path(path)}", _remedy(path)), open_container(path) as container:
        yield container


def open_container(path: Path) -> Any:
    """The file as PyAV opens it.

    Raises:
        D2Error: no file, or one of another kind.
    """
    av = pyav()
    with opened(path, _remedy(path)):  # a pipe or a device would block
        pass
    try:
        return av.open(str(path), options=OPENING)
    except av.error.ArgumentError:
        raise D2Error(
            f"{shown_path(path)} is no video in an MP4, MOV, Matroska, WebM, AVI or MPEG container: {_remedy(path)}"
        ) from None


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
        counted, unit = container.format.name == "avi", Fraction(stream.time_base)
        # Packets that hold a frame that is shown: an edit list may leave some out.
        packets = (packet for packet in container.demux(stream) if packet.size and not packet.is_discard)
        stamps, keys = _stamps(container.decode(stream) if counted else packets, path)
        places = [container, *container.streams.video, *container.streams]
        timecode = next((place.metadata["timecode"] for place in places if "timecode" in place.metadata), None)
        sound, stretched = bool(container.streams.audio), float(stream.sample_aspect_ratio or 1)
        begin = begin_of(container)
    first = _first_frame(path)
    turn = 90 * (round(float(first.rotation) / 90) % 4)
    coding = [
        name for table, code in ((HDR, first.color_trc), (WIDE, first.color_primaries)) if (name := table.get(code))
    ]
    size, hdr = (first.width, first.height), ", ".join(coding)
    shown = stretched, bool(first.interlaced_frame), begin, hdr
    return VideoFile(path, size, turn, stamps, unit, timecode, sound, counted, keys, *shown)


def begin_of(container: Any) -> float:
    """When an MPEG stream begins, in seconds; 0 elsewhere. The stamps of such a stream begin at any number."""
    return (container.start_time or 0) / 1e6 if container.format.name.startswith("mpeg") else 0.0


def _stamps(shown: Iterator[Any], path: Path) -> tuple[np.ndarray, tuple[int, ...]]:
    """(when each frame is shown, ascending, of packets or of decoded frames, `VideoFile.keys` of packets)."""
    stamps: dict[int, bool] = {}
    for one in shown:
        stamp = one.dts if one.pts is None else one.pts
        if stamp is not None:
            stamps[stamp] = getattr(one, "is_keyframe", False)
        if len(stamps) > MOST_FRAMES:
            raise D2Error(f"video {shown_path(path)} has more than {MOST_FRAMES} frames: {_remedy(path)}")
    if not stamps:
        raise D2Error(f"video {shown_path(path)} has no frame: {_remedy(path)}")
    ordered = sorted(stamps)
    return np.array(ordered, np.int64), tuple(place for place, stamp in enumerate(ordered) if stamps[stamp])


def _first_frame(path: Path) -> Any:
    with container_of(path) as container:
        try:
            frame = next(container.decode(video=0))
        except (StopIteration, pyav().error.FFmpegError) as failure:
            why = f" ({said(failure)})" if not isinstance(failure, StopIteration) else ""
            raise D2Error(f"no frame of video {shown_path(path)} can be decoded{why}: {_remedy(path)}") from None
    if not 0 < frame.width * frame.height <= MOST_PIXELS:
        raise D2Error(
            f"video {shown_path(path)} has images of {frame.width}x{frame.height} pixels, at most {MOST_PIXELS}: "
            f"{_remedy(path)}"
        )
    return frame


def usual_rate(rate: float) -> float:
    """A measured rate as cameras have it: 29.97 of stamps that are rounded to whole units is 30000 / 1001."""
    usual = [*map(float, range(1, 241)), *(n * 1000 / 1001 for n in (24, 30, 48, 60, 120, 240))]
    nearest = min(usual, key=lambda one: abs(one - rate))
    return nearest if abs(nearest - rate) < 2e-4 * rate else rate


def videos_below(folder: Path) -> tuple[Path, ...]:
    """The videos directly in a folder, sorted by name."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    left = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in NOT_READ)
    if left:
        _log.warning("%s: %s left out, of a kind that is not read: convert to MP4", folder, ", ".join(left))
    return tuple(path for path in paths if not path.name.startswith("."))


def decoded_alone(video: VideoFile, index: int) -> int:
    """The last frame up to `index` that needs no other one, where the container knows it."""
    place = bisect_right(video.keys, index)
    return video.keys[place - 1] if place else index


class Decoder:
    """Decodes one video and remembers where it stands: frames in ascending order are decoded once each."""

    def __init__(self, video: VideoFile) -> None:
        self.video = video
        self._container: Any = None
        self._frames: Iterator[Any] = iter(())
        self._reached = -1
        """Index of the frame that was decoded last."""

    def image(self, index: int) -> np.ndarray:
        """RGB uint8 [H, W, 3] of frame `index`, upright.

        Raises:
            D2Error: the frame cannot be decoded, or only in part.
        """
        frame = self._frame(index)
        if self.video.hdr:  # what is brighter than white paper, 203 candela per square metre, becomes white
            try:
                frame = frame.reformat(format="rgb24", dst_color_trc=BT709, dst_color_primaries=BT709)
            except TypeError:  # PyAV before it knew transfer functions
                raise D2Error(
                    f"{shown_path(self.video.path)} is HDR ({self.video.hdr}), which this PyAV cannot convert: run "
                    "`pip install -U av`, or convert the video to BT.709"
                ) from None
        return self.video.upright(frame.to_ndarray(format="rgb24"))

    def grey(self, index: int, long_side: int) -> np.ndarray:
        """Brightness uint8 [h, w] of frame `index`, upright, made small: at most `long_side` pixels."""
        frame = self._frame(index)
        scale = min(long_side / max(frame.width, frame.height), 1.0)
        width, height = max(round(scale * frame.width), 1), max(round(scale * frame.height), 1)
        small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
        return self.video.upright(small.to_ndarray())

    def close(self) -> None:
        """Let go of the file."""
        if self._container is not None:
            self._container.close()
        self._container, self._reached = None, -1

    def _frame(self, index: int) -> Any:
        why = ""
        # An MPEG stream, and a group of pictures that is open, may be entered behind the frame: then farther in front.
        for back in (0,) if self.video.counted else (0, 1, 2, len(self.video.stamps)):
            try:
                self._approach(index, back)
                for frame in self._frames:
                    place = self._place(frame)
                    if place < index:
                        continue
                    self._reached = place
                    if place == index and not frame.is_corrupt:
                        return frame
                    break
            except (pyav().error.FFmpegError, OSError, IndexError) as failure:
                why = f" ({said(failure)})"
        self.close()
        raise D2Error(
            f"frame {index} of {shown_path(self.video.path)} cannot be decoded{why}: repair the video, leave "
            f"camera {self.video.path.stem} out, or choose other --times"
        )

    def _place(self, frame: Any) -> int:
        if self.video.counted:
            self._reached += 1
            return self._reached
        stamp = frame.pts if frame.pts is not None else frame.dts
        return -1 if stamp is None else int(np.searchsorted(self.video.stamps, stamp))

    def _approach(self, index: int, back: int) -> None:
        """Stand at the last key frame before `index`, or nearer where that is so; `back` key frames in front of it."""
        key = bisect_right(self.video.keys, index) - 1 - back
        from_the_first = back > 0 and key < 0
        if from_the_first or (self.video.counted and index <= self._reached):
            self.close()
        if self._container is None:
            self._container = open_container(self.video.path)
            self._container.streams.video[0].thread_type = "AUTO"
            self._frames = self._container.decode(video=0)
        if from_the_first or self.video.counted:
            return
        if back or index <= self._reached or decoded_alone(self.video, index) > self._reached + 1:
            stream = self._container.streams.video[0]
            target = self.video.stamps[self.video.keys[key] if back else index]
            self._container.seek(int(target), stream=stream, backward=True)
            self._frames = self._container.decode(video=0)


@dataclass(frozen=True)
class VideoFrames(Source):
    """Upright images out of one video per camera, decoded when asked for; not for several threads at the same time."""

    videos: Mapping[str, VideoFile]
    indices: Mapping[str, Mapping[int, int]] | None = None
    """By camera, the video's frame of each frame of the recording; the same where None."""
    _decoders: dict[str, Decoder] = field(default_factory=dict, repr=False, compare=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        index = frame if self.indices is None else self.indices[camera].get(frame)
        if index is None:
            raise D2Error(f"camera {camera} has no frame {frame}: choose one of the recording's frames")
        if camera not in self._decoders:
            self._decoders[camera] = Decoder(self.videos[camera])
        return self._decoders[camera].image(index)

    def __reduce__(self) -> tuple[Any, ...]:  # another process opens its own decoders
        return VideoFrames, (self.videos, self.indices)

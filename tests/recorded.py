"""Recordings filmed again by cameras that start when they like: videos of a recording with known offsets and gains."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.recordings import Recording
from d2_plugin.recordings.export.folder import described

SOUND_RATE = 48_000
UNIT = Fraction(1, 12_800)
"""Of the time stamps."""


@dataclass(frozen=True)
class Shooting:
    offset: float = 0.0
    """Seconds after the first instant of the recording at which its clock began."""
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turn: int = 0
    dropped: tuple[int, ...] = ()
    """Places of frames, counted from its first, that it never wrote."""
    timecode: str | None = None


def room_sound(seconds: float, seed: int = 0) -> np.ndarray:
    """Claps and quiet noise, float [N]."""
    rng = np.random.default_rng(seed)
    sound = rng.normal(0, 0.003, int(seconds * SOUND_RATE))
    for start in rng.uniform(0, max(seconds - 0.1, 0.01), max(int(8 * seconds), 3)):
        first = int(start * SOUND_RATE)
        length = min(2400, len(sound) - first)
        sound[first : first + length] += rng.normal(0, 0.4, length) * np.exp(-np.arange(length) / 400)
    return sound.clip(-1, 1)


@dataclass
class Filmed:
    """A folder of videos and the calibration of their cameras."""

    folder: Path
    calibration: Path

    @property
    def videos(self) -> Path:
        return self.folder / "videos"


def video(
    recording: Recording,
    folder: Path,
    shootings: Mapping[str, Shooting],
    sound: bool = False,
    sounds: Mapping[str, int] | None = None,
) -> Filmed:
    """Write one video per shooting, with what the room sounds like; `sounds` are seeds of other rooms by camera.

    A camera that begins after the first instant lacks the first frames; one that begins earlier waits for them, and
    its first video frame is the first of the recording at a later time of its own.
    """
    (folder / "videos").mkdir(parents=True)
    length = (len(recording.frames) + 1) / recording.fps
    early = -min(min(one.offset for one in shootings.values()), 0.0)
    for name, shot in shootings.items():
        instants = np.array([recording.seconds(frame) for frame in recording.frames]) - shot.offset
        begun = np.flatnonzero(instants >= -1e-9)
        kept = [i for place, i in enumerate(begun) if place not in shot.dropped]
        images = [graded(recording.image(name, recording.frames[i]), shot.gain) for i in kept]
        heard = None
        if sound:
            rng = np.random.default_rng(sum(name.encode()))
            room = room_sound(length + early, (sounds or {}).get(name, 7))
            own = room[round((early + shot.offset) * SOUND_RATE) :]
            heard = (own * rng.uniform(0.3, 1.0) + rng.normal(0, 0.002, len(own))).clip(-1, 1)
        write_video(
            folder / "videos" / f"{name}.mp4",
            images,
            [max(float(instants[i]), 0.0) for i in kept],
            turn=shot.turn,
            sound=heard,
            timecode=shot.timecode,
        )
    calibration = folder / "cameras.json"
    calibration.write_text(json.dumps(described(recording)))
    return Filmed(folder, calibration)


def graded(image: np.ndarray, gain: tuple[float, float, float]) -> np.ndarray:
    """The image as a camera of another exposure has it."""
    return np.rint(image.astype(float) * gain).clip(0, 255).astype(np.uint8)


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    times: Sequence[float],
    *,
    turn: int = 0,
    sound: np.ndarray | None = None,
    timecode: str | None = None,
    gop: int = 12,
) -> Path:
    """An MP4 of images RGB uint8 [H, W, 3] shown at `times`, seconds, with a key frame every `gop` frames.

    `turn` is what a player does to show it upright, degrees counter-clockwise: the images are stored turned back.
    """
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        rate = Fraction(round(1 / np.median(np.diff(times)))) if len(times) > 1 else Fraction(25)
        stream = container.add_stream("libx264", rate=rate)
        stored = [np.ascontiguousarray(np.rot90(image, -(turn // 90))) for image in images]
        stream.height, stream.width = stored[0].shape[:2]
        stream.pix_fmt, stream.options, stream.gop_size = "yuv420p", {"crf": "8", "preset": "veryfast"}, gop
        stream.time_base = stream.codec_context.time_base = UNIT
        if turn:
            stream.set_display_rotation(turn)
        if timecode is not None:
            stream.metadata["timecode"] = timecode
        track = None
        if sound is not None:
            track = container.add_stream("aac", rate=SOUND_RATE)
            track.bit_rate, track.layout = 128_000, "mono"
        for image, time in zip(stored, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = round(time / float(UNIT)), UNIT
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
        if track is not None and sound is not None:
            for packet in _encoded(av, track, sound):
                container.mux(packet)
    return path


def write_avi(path: Path, images: Sequence[np.ndarray], rate: int, codec: str = "mpeg4", tag: str = "XVID") -> None:
    """An AVI with B-frames, as Xvid writes it."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.bit_rate, stream.gop_size = "yuv420p", 8_000_000, 12
        stream.codec_context.max_b_frames, stream.codec_context.codec_tag = 2, tag
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _encoded(av, track, sound: np.ndarray):
    for start in range(0, len(sound), 1024):
        part = sound[None, start : start + 1024].astype(np.float32)
        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(part), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = SOUND_RATE, start, Fraction(1, SOUND_RATE)
        yield from track.encode(frame)
    yield from track.encode()

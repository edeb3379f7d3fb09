"""Videos that tests make themselves: known offsets, gains, turns, frame times, sound and timecode."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

UNIT = Fraction(1, 12_800)
"""Of the time stamps."""


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    times: Sequence[float],
    *,
    turn: int = 0,
    sound: np.ndarray | None = None,
    sound_rate: int = 48_000,
    timecode: str | None = None,
    crf: int = 8,
    gop: int = 12,
) -> Path:
    """An MP4 of images RGB uint8 [H, W, 3] shown at `times`, seconds.

    `turn` is what a player does to show it upright, degrees counter-clockwise: the images are stored turned back.
    """
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        rate = Fraction(round(1 / np.median(np.diff(times)))) if len(times) > 1 else Fraction(25)
        stream = container.add_stream("libx264", rate=rate)
        stored = [np.ascontiguousarray(np.rot90(image, -(turn // 90))) for image in images]
        stream.height, stream.width = stored[0].shape[:2]
        stream.pix_fmt, stream.options, stream.gop_size = "yuv420p", {"crf": str(crf), "preset": "veryfast"}, gop
        stream.time_base = stream.codec_context.time_base = UNIT
        if turn:
            stream.set_display_rotation(turn)
        if timecode is not None:
            stream.metadata["timecode"] = timecode
        track = None
        if sound is not None:
            track = container.add_stream("aac", rate=sound_rate)
            track.bit_rate, track.layout = 128_000, "mono"
        for image, time in zip(stored, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = round(time / float(UNIT)), UNIT
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
        if track is not None and sound is not None:
            for packet in _encoded(av, track, sound, sound_rate):
                container.mux(packet)
    return path


def _encoded(av, track, sound: np.ndarray, rate: int):
    for start in range(0, len(sound), 1024):
        part = sound[None, start : start + 1024].astype(np.float32)
        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(part), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = rate, start, Fraction(1, rate)
        yield from track.encode(frame)
    yield from track.encode()

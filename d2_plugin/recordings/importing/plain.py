"""Frames out of videos of a constant rate by their number, decoded by OpenCV when asked for: what N3DV needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import opened, parsing, shown_path
from d2_plugin.recordings.images import MOST_PIXELS, opencv

SKIP_LIMIT = 32
"""A frame at most this far ahead is reached by decoding on; any other by a seek, which starts at a key frame."""


MOST_FRAMES = 10_000_000
"""A video that says more is damaged: this many are four days at 30 per second."""


ATOMS = (b"ftyp", b"styp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
"""What an MP4 or MOV may begin with, behind its length."""

BEGINNINGS = (b"\x1aE\xdf\xa3", b"\0\0\1\xba", b"\0\0\1\xb3")
"""Of Matroska and WebM, of an MPEG program stream and of MPEG video."""


PACKETS = ((0, 188), (4, 196))
"""Where the first two packets of an MPEG transport stream begin, without and with time codes."""


class VideoHeader(NamedTuple):
    """What a video says about itself."""

    frames: int
    fps: float  # 0 where the file does not say
    size: tuple[int, int]  # width, height in pixels


@dataclass
class _Decoder:
    video: Any  # cv2.VideoCapture
    next_frame: int = 0


@dataclass
class VideoSource:
    """Frames decoded from one video per camera; each camera's decoder stays open and remembers where it stands.

    Reading frames in ascending order decodes every frame once. Not for several threads at the same time; a copy in
    another process opens its own decoders.
    """

    videos: dict[str, Path]
    _decoders: dict[str, _Decoder] = field(default_factory=dict, repr=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]; raises `D2Error` for a frame that cannot be decoded."""
        cv2 = opencv("reading videos")
        if camera not in self._decoders:
            self._decoders[camera] = _Decoder(_open_video(self.videos[camera]))
        decoder = self._decoders[camera]
        self._advance(decoder, frame)
        decoded, image = decoder.video.read()
        if not decoded:
            del self._decoders[camera]
            raise D2Error(f"frame {frame} of {self.videos[camera]} cannot be decoded: repair the video or leave it out")
        decoder.next_frame = frame + 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def depth(self, camera: str, frame: int) -> None:
        """None: a video carries no true depth."""

    def mono(self, camera: str, frame: int) -> None:
        """None: a video carries no monocular maps."""

    def __getstate__(self) -> dict[str, Any]:
        return {"videos": self.videos, "_decoders": {}}

    @staticmethod
    def _advance(decoder: _Decoder, frame: int) -> None:
        if not 0 <= frame - decoder.next_frame <= SKIP_LIMIT:
            decoder.video.set(opencv("reading videos").CAP_PROP_POS_FRAMES, frame)
            decoder.next_frame = frame
        for _ in range(frame - decoder.next_frame):
            decoder.video.grab()


def video_header(path: Path) -> VideoHeader:
    """Number of frames, frame rate and size, without decoding a frame."""
    cv2 = opencv("reading videos")
    video = _open_video(path)
    try:
        size = (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        fps = max(float(video.get(cv2.CAP_PROP_FPS)), 0.0)
        frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if frames > MOST_FRAMES or not 0 < size[0] * size[1] <= MOST_PIXELS:
            raise D2Error(
                f"video {shown_path(path)} says {frames} frames of {size[0]}x{size[1]} pixels, at most {MOST_FRAMES} "
                f"of {MOST_PIXELS}: replace the file or leave its camera out"
            )
        return VideoHeader(frames, fps, size)
    finally:
        video.release()


def check_container(path: Path) -> None:
    """Refuse what holds no video itself: FFmpeg also follows playlists and scripts to other files and addresses.

    Raises:
        D2Error: a file that cannot be read, or that begins like none of the containers that cameras write.
    """
    with opened(path, "replace the file or leave its camera out") as file:  # a pipe or a device would block
        head = file.read(256)
    riff = head[:4] == b"RIFF" and head[8:11] == b"AVI"
    transport = any(head[first : first + 1] == b"G" == head[second : second + 1] for first, second in PACKETS)
    if not (riff or transport or head[4:8] in ATOMS or head[:4] in BEGINNINGS):
        raise D2Error(
            f"{shown_path(path)} is no video in an MP4, MOV, Matroska, WebM, AVI or MPEG container: replace the file "
            "or leave its camera out"
        )


def _open_video(path: Path) -> Any:
    check_container(path)
    with parsing(f"video {shown_path(path)}", "replace the file or leave its camera out"):
        video = opencv("reading videos").VideoCapture(str(path))
    if not video.isOpened():
        raise D2Error(f"video {path} cannot be opened: replace the file or leave its camera out")
    return video

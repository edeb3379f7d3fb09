"""Images out of a video by their time stamps, decoded when asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import said, shown_path
from d2_plugin.recordings.importing.files import VideoFile, pyav
from d2_plugin.recordings.importing.plain import check_container

SKIP_LIMIT = 48
"""A frame at most this far ahead is reached by decoding on; any other by a seek, which starts at a key frame."""


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
        return self.video.turn.of(self._frame(index).to_ndarray(format="rgb24"))

    def grey(self, index: int, long_side: int) -> np.ndarray:
        """Brightness uint8 [h, w] of frame `index`, upright, made small: at most `long_side` pixels."""
        frame = self._frame(index)
        scale = min(long_side / max(frame.width, frame.height), 1.0)
        width, height = max(round(scale * frame.width), 1), max(round(scale * frame.height), 1)
        small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
        return self.video.turn.of(small.to_ndarray())

    def close(self) -> None:
        """Let go of the file."""
        if self._container is not None:
            self._container.close()
        self._container, self._reached = None, -1

    def _frame(self, index: int) -> Any:
        """The decoded frame whose stamp is that of `index`."""
        try:
            self._approach(index)
            for frame in self._frames:
                place = self._place(frame)
                if place < index:
                    continue
                self._reached = place
                if place > index or frame.is_corrupt:
                    break
                return frame
        except (pyav().error.FFmpegError, OSError) as failure:
            self.close()
            raise self._undecodable(index, f" ({said(failure)})") from None
        self.close()
        raise self._undecodable(index)

    def _approach(self, index: int) -> None:
        """Open the file where it is not, and stand at most `SKIP_LIMIT` frames before `index` if one can."""
        if self._container is None:
            check_container(self.video.path)
            self._container = pyav().open(str(self.video.path))
            self._container.streams.video[0].thread_type = "AUTO"
            self._frames = self._container.decode(video=0)
        if not 0 < index - self._reached <= SKIP_LIMIT:
            stream = self._container.streams.video[0]
            self._container.seek(int(self.video.stamps[index]), stream=stream, backward=True)
            self._frames = self._container.decode(video=0)

    def _place(self, frame: Any) -> int:
        stamp = frame.pts if frame.pts is not None else frame.dts
        return -1 if stamp is None else int(np.searchsorted(self.video.stamps, stamp))

    def _undecodable(self, index: int, why: str = "") -> D2Error:
        return D2Error(
            f"frame {index} of {shown_path(self.video.path)} cannot be decoded{why}: repair the video, leave its "
            "camera out, or choose other --times"
        )

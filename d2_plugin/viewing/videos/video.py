"""Images into a file that others play: MP4 for browsers, animated WebP or GIF for a page, PNGs for measurements.

H.264 with half the colour resolution needs even sides: an image of odd width or height gets one more column or row, a
copy of its last. Nothing is scaled. Scores are never computed from a video.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from d2_plugin.durable import LEFTOVER, make_folder, remove_leftovers, writing
from d2_plugin.errors import D2Error
from d2_plugin.extras import import_av
from d2_plugin.locks import one_of_many
from d2_plugin.reading import said
from d2_plugin.recordings.images import checked_image, write_png
from d2_plugin.values import checked_arguments

Format = Literal["mp4", "webp", "gif", "png"]
RATES = (0.001, 1000.0)
"""Images per second that files of videos can say."""


class Encoding(NamedTuple):
    """FFmpeg's names for one format."""

    muxer: str
    codec: str
    pixels: str
    options: dict[str, str]
    """Of the container."""


ENCODINGS = {
    "mp4": Encoding("mp4", "libx264", "yuv420p", {"movflags": "+faststart"}),
    "webp": Encoding("webp", "libwebp_anim", "yuv420p", {"loop": "0"}),
    "gif": Encoding("gif", "gif", "pal8", {"loop": "0"}),
}


class Video(Protocol):
    """A video that is being written."""

    def add(self, image: np.ndarray) -> None: ...


@checked_arguments
@contextmanager
def write_video(path: Path, form: Format, fps: float, quality: int = 18) -> Iterator[Video]:
    """A video at `path`, complete when the block ends; what stood there is replaced then and not before.

    Args:
        path: the file; a folder of 00000.png, ... for `png`.
        form: mp4 (H.264, yuv420p, fast start), webp and gif (endless loops), or png.
        fps: images per second.
        quality: x264's constant rate factor for mp4, 0 is lossless and 51 the worst; webp's quality is 100 less twice
            this number.
    """
    if not RATES[0] <= fps <= RATES[1]:
        raise D2Error(f"a video has {fps:g} images per second, expected {RATES[0]:g} to {RATES[1]:g}: correct them")
    if form == "png":
        yield _Pngs(make_folder(path))
        return
    if path.suffix.lower() != f".{form}":  # a typing error must not replace another kind of file
        raise D2Error(f"a video of format {form} needs a name that ends so, got {path.name}: mend the name or --format")
    folder = make_folder(path.parent)
    with one_of_many(folder, lambda: remove_leftovers(folder, below=False)):
        unfinished = path.with_name(f".{secrets.token_hex(8)}{LEFTOVER}")
        try:
            with _encoding(path):
                video = _Encoded(unfinished, form, _rate(fps), quality)
                try:
                    yield video
                    video.close()
                finally:
                    video.abandon()
                os.replace(unfinished, path)
        finally:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)


@contextmanager
def _encoding(path: Path) -> Iterator[None]:
    """Within it, whatever FFmpeg or the system says against a video is one sentence."""
    with writing(path):
        try:
            yield
        except (D2Error, OSError):
            raise
        except (import_av("writing videos").error.FFmpegError, OverflowError) as error:
            raise D2Error(
                f"cannot write the video {path} ({said(error)}): choose other --width, --height or --fps, or another "
                "--format"
            ) from None


class _Pngs:
    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0

    def add(self, image: np.ndarray) -> None:
        """Write one image."""
        write_png(self.folder / f"{self.count:05d}.png", checked_image(image, "an image of a video"))
        self.count += 1


class _Encoded:
    """One stream in one container."""

    def __init__(self, path: Path, form: str, rate: Fraction, quality: int) -> None:
        self.av, self.form, self.rate, self.quality, self.count = import_av("writing videos"), form, rate, quality, 0
        encoding = ENCODINGS[form]
        self.container: Any = self.av.open(str(path), "w", format=encoding.muxer, options=encoding.options)
        self.stream: Any = None
        self.palette: Any = None

    def add(self, image: np.ndarray) -> None:
        """Encode one image, RGB uint8 [H, W, 3]; all have the size of the first."""
        image = checked_image(image, "an image of a video")
        if self.form == "mp4":
            image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        height, width = image.shape[:2]
        if self.stream is None:
            self._begin(width, height)
        if (self.stream.width, self.stream.height) != (width, height):
            raise D2Error(f"a video of {self.stream.width}x{self.stream.height} pixels got {(width, height)}")
        frame = self.av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = self.count, 1 / self.rate
        self.count += 1
        if self.form == "gif":  # kept until the end: the palette is that of all images
            self.palette = self.palette or self._palette(frame)
            self.palette[0].push(frame)
        else:
            self._mux(self.stream.encode(self._bt709(frame) if self.form == "mp4" else frame))

    def close(self) -> None:
        """Write what is still inside."""
        if self.stream is None:
            raise D2Error("a video without an image: choose a longer path or more frames")
        if self.palette is not None:
            source, sink = self.palette
            source.push(None)
            with suppress(self.av.error.EOFError, self.av.error.BlockingIOError):
                while True:
                    self._mux(self.stream.encode(sink.pull()))
        self._mux(self.stream.encode())
        self.container.close()
        self.container = None

    def abandon(self) -> None:
        """Release the file where `close` was not reached."""
        if self.container is not None:
            with suppress(self.av.error.FFmpegError, OSError):  # the earlier error is the one that is reported
                self.container.close()
            self.container = None

    def _begin(self, width: int, height: int) -> None:
        encoding = ENCODINGS[self.form]
        self.stream = self.container.add_stream(encoding.codec, rate=self.rate)
        self.stream.width, self.stream.height, self.stream.pix_fmt = width, height, encoding.pixels
        if self.form == "webp":
            self.stream.options = {"quality": str(max(100 - 2 * self.quality, 0)), "compression_level": "6"}
        if self.form == "mp4":
            self.stream.options = {"crf": str(self.quality), "preset": "medium", "profile": "high"}
            self.stream.gop_size = max(round(self.rate), 1)
            context, colors = self.stream.codec_context, self.av.video.reformatter
            context.colorspace, context.color_range = colors.Colorspace.ITU709, colors.ColorRange.MPEG
            context.color_primaries, context.color_trc = colors.ColorPrimaries.BT709, colors.ColorTrc.BT709

    def _bt709(self, frame: Any) -> Any:
        colors = self.av.video.reformatter
        converted = frame.reformat(
            format="yuv420p",
            dst_colorspace=colors.Colorspace.ITU709,
            dst_color_range=colors.ColorRange.MPEG,
            interpolation=colors.Interpolation.AREA,
        )
        converted.pts, converted.time_base = frame.pts, frame.time_base
        return converted

    def _palette(self, frame: Any) -> tuple[Any, Any]:
        """Where images go in, and where they come out with the one palette of all of them."""
        graph = self.av.filter.Graph()
        size = {"width": frame.width, "height": frame.height}
        source = graph.add_buffer(**size, format=frame.format, time_base=frame.time_base)
        split, palette, use = graph.add("split"), graph.add("palettegen"), graph.add("paletteuse", "dither=bayer")
        sink = graph.add("buffersink")
        source.link_to(split)
        split.link_to(palette, 0, 0)
        split.link_to(use, 1, 0)
        palette.link_to(use, 0, 1)
        use.link_to(sink)
        graph.configure()
        self.graph = graph  # kept alive: it owns both ends
        return source, sink

    def _mux(self, packets: Any) -> None:
        for packet in packets:
            self.container.mux(packet)


def _rate(fps: float) -> Fraction:
    """Images per second as a ratio that containers keep: 29.97 is 30000/1001."""
    ntsc = Fraction(round(fps * 1.001) * 1000, 1001)
    is_ntsc = abs(float(ntsc) - fps) < 2e-3 and abs(fps - round(fps)) > 1e-3
    return ntsc if is_ntsc else Fraction(fps).limit_denominator(1000)

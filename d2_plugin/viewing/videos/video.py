"""Images into a file that others play: MP4 for browsers, animated WebP for a page, PNGs for measurements.

H.264 with half the colour resolution needs even sides: an image of odd width or height gets one more column or row, a
copy of its last. Nothing is scaled. Scores are never computed from a video.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np

from d2_plugin.durable import make_folder, remove_leftovers, replacing
from d2_plugin.errors import D2Error
from d2_plugin.extras import import_av
from d2_plugin.locks import one_of_many
from d2_plugin.reading import said
from d2_plugin.recordings.images import checked_image, write_png
from d2_plugin.values import checked_arguments

Format = Literal["mp4", "webp", "png"]
RATES = (0.001, 1000.0)
"""Images per second that files of videos can say."""

CODECS = {"mp4": ("libx264", {"movflags": "+faststart"}), "webp": ("libwebp_anim", {"loop": "0"})}
"""FFmpeg's name of a format's codec, and the options of its container."""

Add = Callable[[np.ndarray], None]
"""Adds an image, RGB uint8 [H, W, 3], to a video; all have the size of the first."""


@checked_arguments
@contextmanager
def write_video(path: Path, form: Format, fps: float, quality: int = 18) -> Iterator[Add]:
    """A video at `path`, complete when the block ends; what stood there is replaced then and not before.

    Args:
        path: the file; a folder of 00000.png, ... for `png`.
        form: mp4 (H.264, yuv420p, fast start), webp (an endless loop), or png.
        fps: images per second.
        quality: x264's constant rate factor for mp4, 0 is lossless and 51 the worst; webp's quality is 100 less twice
            this number.
    """
    if not RATES[0] <= fps <= RATES[1]:
        least, most = RATES
        raise D2Error(f"a video of {fps:g} images per second cannot be: give --fps from {least:g} to {most:g}")
    if form == "png":
        folder, number = make_folder(path), itertools.count()
        yield lambda image: write_png(folder / f"{next(number):05d}.png", checked_image(image, "an image of a video"))
        while (left := folder / f"{next(number):05d}.png").is_file():  # of a longer video that stood here
            left.unlink()
        return
    if path.suffix.lower() != f".{form}":  # a typing error must not replace another kind of file
        raise D2Error(f"a video of format {form} needs a name that ends so, got {path.name}: mend the name or --format")
    folder, av = make_folder(path.parent), import_av("writing videos")
    with one_of_many(folder, lambda: remove_leftovers(folder, below=False)), replacing(path) as unfinished:
        try:
            encoder = _Encoder(av, unfinished, form, _rate(fps), quality)
            try:
                yield encoder.add
                encoder.close()
            finally:
                with suppress(av.error.FFmpegError, OSError):  # the earlier error is the one that is reported
                    encoder.container.close()
        except (D2Error, OSError):
            raise
        except (av.error.FFmpegError, OverflowError) as error:
            raise D2Error(
                f"cannot write the video {path} ({said(error)}): choose other --width, --height or --fps, or another "
                "--format"
            ) from None


class _Encoder:
    def __init__(self, av: Any, path: Path, form: str, rate: Fraction, quality: int) -> None:
        self.av, self.form, self.rate, self.quality, self.count = av, form, rate, quality, 0
        exact = {"movie_timescale": str(rate.numerator)} if form == "mp4" else {}  # else a length in whole milliseconds
        self.container: Any = av.open(str(path), "w", format=form, options=CODECS[form][1] | exact)
        self.stream: Any = None

    def add(self, image: np.ndarray) -> None:
        image = checked_image(image, "an image of a video")
        if self.form == "mp4":
            image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        height, width = image.shape[:2]
        if self.stream is None:
            self._begin(width, height)
        if (self.stream.width, self.stream.height) != (width, height):
            raise D2Error(f"a video of {self.stream.width}x{self.stream.height} pixels got {(width, height)}")
        frame = self.av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        if self.form == "mp4":
            colors = self.av.video.reformatter
            to = {"dst_colorspace": colors.Colorspace.ITU709, "dst_color_range": colors.ColorRange.MPEG}
            frame = frame.reformat(format="yuv420p", interpolation=colors.Interpolation.AREA, **to)
        frame.pts, frame.time_base = self.count, 1 / self.rate
        self.count += 1
        self.container.mux(self.stream.encode(frame))

    def close(self) -> None:
        if self.stream is None:
            raise D2Error("a video without an image: choose a longer path or more frames")
        self.container.mux(self.stream.encode())
        self.container.close()

    def _begin(self, width: int, height: int) -> None:
        self.stream = self.container.add_stream(CODECS[self.form][0], rate=self.rate)
        self.stream.width, self.stream.height, self.stream.pix_fmt = width, height, "yuv420p"
        if self.form == "webp":
            self.stream.options = {"quality": str(max(100 - 2 * self.quality, 0)), "compression_level": "6"}
        if self.form == "mp4":
            self.stream.options = {"crf": str(self.quality), "preset": "medium", "profile": "high"}
            self.stream.gop_size = max(round(self.rate), 1)
            context, colors = self.stream.codec_context, self.av.video.reformatter
            context.colorspace, context.color_range = colors.Colorspace.ITU709, colors.ColorRange.MPEG
            context.color_primaries, context.color_trc = colors.ColorPrimaries.BT709, colors.ColorTrc.BT709


def _rate(fps: float) -> Fraction:
    """Images per second as a ratio that containers keep: 29.97 is 30000/1001."""
    ntsc = Fraction(round(fps * 1.001) * 1000, 1001)
    is_ntsc = abs(float(ntsc) - fps) < 2e-3 and abs(fps - round(fps)) > 1e-3
    return ntsc if is_ntsc else Fraction(fps).limit_denominator(1000)

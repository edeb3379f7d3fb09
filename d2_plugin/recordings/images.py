"""Images and masks on disk: read, measured without decoding, written, and made smaller."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np

from d2_plugin.durable import write
from d2_plugin.errors import D2Error
from d2_plugin.extras import imported
from d2_plugin.reading import opened, parsing, read_bytes, shown_path
from d2_plugin.values import shown

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

MASK_FOLDERS = ("masks", "fmasks", "mask", "bgmtv2")
"""Where masks of the foreground (people, or whatever the scene is about) may lie as FOLDER/<camera>/<frame>.png, in the
order in which they are tried: this project's own, Diffuman4D's, EasyMocap's, ENeRF's and EasyVolcap's. White counts
fully, grey in part."""

VALID_FOLDER = "valid"  # valid/<camera>.png is black where nothing was recorded: undistorting leaves such pixels
MOST_PIXELS = 1 << 28  # larger images are refused before anything is decoded: 16384 x 16384

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_WITH_OPACITY = (b"\4", b"\6")  # colour types in the header's byte 25: grey and RGB, each with opacity
_HEAD = 1 << 22  # bytes in which the size of an image stands; profiles of a JPEG may come before it
_REMEDY = "replace the file or leave this frame out"
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0..15 without DHT, JPG, DAC

_SCAN = frozenset({0xDA})  # what follows it has no end marker but its own; a thumbnail has one before


def opencv(purpose: str, extra: str = "image") -> ModuleType:
    """The module cv2; `purpose` completes the sentence "<purpose> needs OpenCV".

    Raises:
        MissingExtra: where it is not installed; the sentence names `extra`, the extra of this package that brings it.
    """
    return imported("cv2", "OpenCV", extra, purpose)


def read_image(path: Path) -> np.ndarray:
    """RGB uint8 [H, W, 3] of a PNG or JPEG file, in the pixel order it is stored in (no EXIF rotation).

    A transparent PNG, as Blender scenes have, is laid over black.
    """
    cv2 = opencv("reading images")
    encoded = _whole(path)
    one_colour = encoded[25:26] != b"\0" and b"tRNS" in encoded[: encoded.find(b"IDAT")]  # or some, of a palette
    transparent = encoded.startswith(_PNG_SIGNATURE) and (encoded[25:26] in _WITH_OPACITY or one_colour)
    # The calibration belongs to the stored pixels: EXIF's orientation is ignored, as IMREAD_UNCHANGED does too.
    flags = cv2.IMREAD_UNCHANGED if transparent else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = _decoded(path, encoded, flags)
    return _over_black(image) if image.shape[2] == 4 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def checked_image(image: object, what: str) -> np.ndarray:
    """What somebody handed over as an image; a D2Error where it is no RGB uint8 [H, W, 3]."""
    if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.shape[2:] == (3,) and image.size:
        return image
    given = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else shown(image)
    raise D2Error(f"{what} is {given}, expected RGB uint8 [H, W, 3]: give an image as `read_image` returns it")


def read_numbers(path: Path) -> np.ndarray:
    """An image as it is stored, of any depth and number of channels: [H, W] or [H, W, C]."""
    return _decoded(path, _whole(path), opencv("reading images").IMREAD_UNCHANGED)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels from the header of a PNG or JPEG file; nothing is decoded."""
    with opened(path, _REMEDY) as file:
        return _size(path, file.read(_HEAD))


def write_png(path: Path, image: np.ndarray) -> None:
    """Write RGB uint8 [H, W, 3] as a PNG."""
    write(path, opencv("writing images").imencode(".png", image[..., ::-1])[1].data, synced=False)


def read_mask(path: Path) -> np.ndarray:
    """An image of any number of channels as one number per pixel, 0..1: its opacity where not all is opaque."""
    stored = read_numbers(path)
    full = float(np.iinfo(stored.dtype).max) if np.issubdtype(stored.dtype, np.integer) else 1.0
    if stored.ndim == 3:
        cut_out = stored.shape[2] == 4 and stored[..., 3].min() < full
        stored = stored[..., 3] if cut_out else stored[..., :3].max(axis=2)
    return (stored.astype(np.float32) / np.float32(full)).clip(0, 1)


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask [H, W] in 0..1, or of true and false, as a grey image."""
    grey = np.rint(mask.astype(np.float32) * 255).astype(np.uint8)
    write_png(path, np.repeat(grey[..., None], 3, axis=2))


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """RGB uint8 [H, W, 3] as a JPEG file."""
    cv2 = opencv("writing JPEG images")
    with parsing(f"an image of {image.shape[1]}x{image.shape[0]} pixels", "make it smaller, JPEG has 65535 a side"):
        encoded: bytes = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return encoded


def color_bytes(colors: np.ndarray) -> np.ndarray:
    """uint8 of colours in 0..1."""
    return np.clip(np.rint(np.asarray(colors) * 255), 0, 255).astype(np.uint8)


def shrink_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks of factor x factor pixels, uint8 [H // factor, W // factor, 3]; an incomplete block is cut off.

    Cutting (instead of stretching) keeps the new pixel grid exactly `factor` times coarser, so that K / factor holds.
    """
    blocks, area = _blocks(image, factor), factor * factor
    total = np.zeros_like(blocks[:, 0, :, 0], dtype=np.uint32)
    for row, column in np.ndindex(factor, factor):  # NumPy's own sum over two short axes takes five times as long
        total += blocks[:, row, :, column]
    return ((total + area // 2) // area).astype(np.uint8)


def shrink_mask(mask: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks of factor x factor pixels, float32 [H // factor, W // factor]; see `shrink_image`."""
    return _blocks(mask, factor).mean(axis=(1, 3), dtype=np.float32)


def shrink_depth(depth: np.ndarray, factor: int, tolerance: float = 0.05) -> np.ndarray:
    """Depth float32 [H // factor, W // factor] of blocks of pixels; 0 (unknown) where no depth in a block is known.

    A plain mean would put points into the air at depth edges: the mean goes over the pixels of a block that lie
    within the relative `tolerance` of the block's (lower) median, so that every value belongs to one surface.
    """
    blocks = np.moveaxis(_blocks(depth, factor), 2, 1)
    values = np.sort(blocks.reshape(*blocks.shape[:2], factor * factor), axis=-1).astype(np.float64)
    known = (values > 0).sum(axis=-1, keepdims=True)
    # The unknown zeros are sorted to the front, the known depths occupy the last `known` places.
    median_place = np.minimum(values.shape[-1] - known + (known - 1) // 2, values.shape[-1] - 1)
    median = np.take_along_axis(values, median_place, axis=-1)
    near = (np.abs(values - median) <= tolerance * median) & (values > 0)
    return ((values * near).sum(axis=-1) / np.maximum(near.sum(axis=-1), 1)).astype(np.float32)


def _blocks(array: np.ndarray, factor: int) -> np.ndarray:
    """View of [H, W, ...] as [H // factor, factor, W // factor, factor, ...]."""
    rows, columns = array.shape[0] // factor, array.shape[1] // factor
    return array[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, *array.shape[2:])


def _whole(path: Path) -> bytes:
    """The bytes of an image that says a possible size and was not cut off."""
    encoded = read_bytes(path, _REMEDY)
    _size(path, encoded)
    # Decoders fill in what is missing without a word.
    if encoded.startswith(_PNG_SIGNATURE):
        if not _png_is_whole(encoded):
            raise _unreadable(path, " (cut off, or its checksums are wrong)")
    elif encoded.find(b"\xff\xd9", _jpeg_segment(path, encoded, _SCAN)) < 0:  # a phone may append a video to it
        raise _unreadable(path, " (cut off: its end marker is missing)")
    return encoded


def _decoded(path: Path, encoded: bytes, flags: int) -> np.ndarray:
    with parsing(f"image {shown_path(path)}", _REMEDY):
        image = opencv("reading images").imdecode(np.frombuffer(encoded, np.uint8), flags)
    if image is None:
        raise _unreadable(path)
    return image


def _size(path: Path, data: bytes) -> tuple[int, int]:
    if data.startswith(_PNG_SIGNATURE) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
    elif data.startswith(b"\xff\xd8"):
        position = _jpeg_segment(path, data, _JPEG_SIZE_MARKERS)
        height, width = struct.unpack(">HH", data[position + 5 : position + 9])
    else:
        raise _unreadable(path)
    if not 0 < width * height <= MOST_PIXELS:
        raise D2Error(f"image {shown_path(path)} says {width}x{height} pixels, at most {MOST_PIXELS}: {_REMEDY}")
    return width, height


def _png_is_whole(data: bytes) -> bool:
    """Whether all chunks of a PNG up to its last one are there with the right checksums."""
    place = len(_PNG_SIGNATURE)
    while place + 12 <= len(data):
        (length,) = struct.unpack(">I", data[place : place + 4])
        end = place + 8 + length
        if data[end : end + 4] != struct.pack(">I", zlib.crc32(memoryview(data)[place + 4 : end])):
            return False
        if data[place + 4 : place + 8] == b"IEND":
            return True
        place = end + 4
    return False


def _jpeg_segment(path: Path, data: bytes, markers: frozenset[int]) -> int:
    """Where the first segment of one of the `markers` begins."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], struct.unpack(">H", data[position + 2 : position + 4])[0]
        if marker in markers:
            return position
        position += 1 if marker == 0xFF else 2 + length  # a fill byte, or a whole segment
    raise _unreadable(path)


def _over_black(image: np.ndarray) -> np.ndarray:
    """RGB uint8 of blue, green, red and opacity with 8 or 16 bits."""
    full = np.iinfo(image.dtype).max
    opaque = image[..., 2::-1].astype(np.float64) * (image[..., 3:].astype(np.float64) / full)
    return np.rint(opaque * (255 / full)).astype(np.uint8)


def _unreadable(path: Path, why: str = "") -> D2Error:
    return D2Error(f"image {shown_path(path)} is not a readable PNG or JPEG{why}: {_REMEDY}")

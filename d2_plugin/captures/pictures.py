"""Pictures on disk: read, measured without decoding, written without any extra package, and made smaller."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np

from d2_plugin.durable import write
from d2_plugin.errors import D2Error, missing_extra

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_RGBA = 6  # colour type in the header's byte 25
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0..15 without DHT, JPG, DAC


def opencv(purpose: str, extra: str = "image") -> ModuleType:
    """The module cv2; `purpose` completes the sentence "<purpose> needs OpenCV".

    Raises:
        MissingExtra: where it is not installed; the sentence names `extra`, the extra of this package that brings it.
    """
    try:
        import cv2
    except ImportError:
        raise missing_extra("OpenCV", extra, purpose) from None
    return cv2


def read_picture(path: Path) -> np.ndarray:
    """RGB uint8 [H, W, 3] of a PNG or JPEG file, in the pixel order it is stored in (no EXIF rotation).

    A transparent PNG, as Blender scenes have, is laid over black.
    """
    cv2 = opencv("reading pictures")
    encoded = _bytes_of(path)
    transparent = encoded.startswith(_PNG_SIGNATURE) and len(encoded) > 25 and encoded[25] == _PNG_RGBA
    # The calibration belongs to the stored pixels: EXIF's orientation is ignored, as IMREAD_UNCHANGED does too.
    flags = cv2.IMREAD_UNCHANGED if transparent else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags) if encoded else None
    if picture is None:
        raise _unreadable(path)
    return _over_black(picture) if transparent else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels from the header of a PNG or JPEG file; nothing is decoded."""
    data = _bytes_of(path)
    if data.startswith(_PNG_SIGNATURE) and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(path, data)
    raise _unreadable(path)


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write RGB uint8 [H, W, 3] as a PNG; needs nothing but the standard library."""
    height, width, _ = picture.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)
    flat = picture.reshape(height, 3 * width)
    rows[:, 0] = 1  # filter "sub": differences to the pixel on the left compress better than the pixels
    rows[:, 1:4] = flat[:, :3]
    rows[:, 4:] = flat[:, 3:] - flat[:, :-3]
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 3)), (b"IEND", b""))
    write(path, _PNG_SIGNATURE, *(_png_chunk(kind, body) for kind, body in chunks), synced=False)


def shrink_picture(picture: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks of factor x factor pixels, uint8 [H // factor, W // factor, 3]; an incomplete block is cut off.

    Cutting (instead of stretching) keeps the new pixel grid exactly `factor` times coarser, so that K / factor holds.
    """
    blocks = _blocks(picture, factor)
    total = blocks.astype(np.uint32).sum(axis=(1, 3))
    area = factor * factor
    return ((total + area // 2) // area).astype(np.uint8)


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


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as failure:
        raise D2Error(f"cannot read picture {path}: {failure.strerror}; put the file back or drop the frame") from None


def _jpeg_size(path: Path, data: bytes) -> tuple[int, int]:
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], struct.unpack(">H", data[position + 2 : position + 4])[0]
        if marker in _JPEG_SIZE_MARKERS:
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        if marker == 0xFF:  # fill byte before a marker
            position += 1
        else:
            position += 2 + length
    raise _unreadable(path)


def _over_black(picture: np.ndarray) -> np.ndarray:
    """RGB uint8 of blue, green, red and opacity with 8 or 16 bits."""
    full = np.iinfo(picture.dtype).max
    opaque = picture[..., 2::-1].astype(np.float64) * (picture[..., 3:].astype(np.float64) / full)
    return np.rint(opaque * (255 / full)).astype(np.uint8)


def _png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _unreadable(path: Path) -> D2Error:
    return D2Error(f"picture {path} is not a readable PNG or JPEG: replace the file or leave this frame out")

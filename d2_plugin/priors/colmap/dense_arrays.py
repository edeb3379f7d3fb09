"""COLMAP's dense arrays on disk: `stereo/depth_maps/*.bin` and `stereo/normal_maps/*.bin` of a workspace.

A file is the text `W&H&C&` followed by little-endian float32, channel by channel (COLMAP, `mvs/mat.h`): a depth map is
[H, W], a normal map [3, H, W]. pycolmap's own `NormalMap.to_array` reads them as if channels were interleaved, which
scrambles normals; hence a reader of our own. A depth of 0 means that there is none.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import read_bytes

_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,2})&")
_HEADER_LENGTH = 64  # bytes, more than any header has


def read_dense_array(path: Path) -> np.ndarray:
    """A depth map as float32 [H, W], or an array of C channels as float32 [H, W, C].

    Raises:
        D2Error: there is no such file, it has no header, or more or fewer numbers than the header says.
    """
    data = read_bytes(path, "let COLMAP compute the map again")
    header = _HEADER.match(data[:_HEADER_LENGTH])
    if header is None:
        raise D2Error(f"{path} does not begin with width&height&channels& as COLMAP's maps do: compute it again")
    width, height, channels = (int(number) for number in header.groups())
    if width * height * channels == 0:
        raise D2Error(f"{path} is a map of {width}x{height}x{channels}, without a pixel: compute it again")
    found, expected = len(data) - header.end(), 4 * width * height * channels
    if found != expected:
        raise D2Error(
            f"{path} holds {found} bytes of numbers but {width}x{height}x{channels} need {expected}: compute it again"
        )
    planes = np.frombuffer(data, "<f4", offset=header.end()).reshape(channels, height, width)
    values = planes[0] if channels == 1 else planes.transpose(1, 2, 0)
    return np.ascontiguousarray(values, dtype=np.float32)


def write_dense_array(path: Path, values: np.ndarray) -> None:
    """Write a depth map [H, W] or an array [H, W, C] as COLMAP would."""
    planes = values[None] if values.ndim == 2 else values.transpose(2, 0, 1)
    channels, height, width = planes.shape
    header = f"{width}&{height}&{channels}&".encode()
    path.write_bytes(header + np.ascontiguousarray(planes, dtype="<f4").tobytes())

"""COLMAP's depth maps on disk: `stereo/depth_maps/*.bin` of a workspace.

A file is the text `W&H&1&` followed by little-endian float32 (COLMAP, `mvs/mat.h`). A depth of 0 means that there is
none.
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
    """A depth map as float32 [H, W].

    Raises:
        D2Error: there is no such file, it has no header, or more or fewer numbers than the header says.
    """
    data = read_bytes(path, "let COLMAP compute the map again")
    header = _HEADER.match(data[:_HEADER_LENGTH])
    if header is None:
        raise D2Error(f"{path} does not begin with width&height&channels& as COLMAP's maps do: compute it again")
    width, height, channels = (int(number) for number in header.groups())
    if width * height == 0 or channels != 1:
        raise D2Error(f"{path} is {width}x{height}x{channels}, expected pixels of one number each: compute it again")
    held, expected = len(data) - header.end(), 4 * width * height
    if held != expected:
        raise D2Error(f"{path} holds {held} bytes of numbers but {width}x{height} need {expected}: compute it again")
    depth = np.frombuffer(data, "<f4", offset=header.end()).reshape(height, width)
    return np.ascontiguousarray(depth, dtype=np.float32)

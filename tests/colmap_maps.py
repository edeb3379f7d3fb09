"""Depth maps as COLMAP writes them, for tests of what reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_dense_array(path: Path, depth: np.ndarray) -> None:
    """Write a depth map [H, W] as COLMAP would."""
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + np.ascontiguousarray(depth, dtype="<f4").tobytes())

"""Depth maps in NumPy between their pixels, as the kernels of filter and `cross_view` read them."""

from __future__ import annotations

import numpy as np

from d2_plugin.priors.geometry import CONTINUOUS


def interpolated_surface(depth: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A depth map [H, W] between its pixels: (where four neighbours are one surface, depth there), shaped like x and y.

    Bilinear in inverse depth, which is linear over a plane. x and y are array indices, NaN-free.
    """
    height, width = depth.shape
    if min(height, width) < 2:
        return np.zeros(x.shape, bool), np.ones(x.shape)
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    left = np.clip(np.floor(np.where(inside, x, 0)), 0, width - 2).astype(np.int64)
    top = np.clip(np.floor(np.where(inside, y, 0)), 0, height - 2).astype(np.int64)
    right, down = np.where(inside, x, 0) - left, np.where(inside, y, 0) - top
    first, flat = top * width + left, np.ascontiguousarray(depth).ravel()
    corners = [flat[first + offset] for offset in (0, 1, width, width + 1)]
    nearest, farthest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    known = inside & (nearest > 0) & (farthest < CONTINUOUS * nearest)
    inverse = [1 / np.where(known, corner, 1).astype(np.float64) for corner in corners]
    upper, lower = (inverse[i] * (1 - right) + inverse[i + 1] * right for i in (0, 2))
    return known, 1 / (upper * (1 - down) + lower * down)

"""How precise a geometric depth is: matching precision through the parallax, and what neighbours and sources say.

A match that is off by e pixels puts the depth off by e / P, where P is the parallax: by how many pixels the match moves
in the confirming sources when the depth changes by its own size. That alone is the textbook's answer; two things that a
map knows about itself tell where it is too good: how far depths scatter about the plane of their neighbours, and how
far the depth of a confirming source lies from ours.

    sigma^2 = ((m + c cost + k (1 - coherence)) / P)^2 + (r scatter)^2 + (s spread)^2 + floor^2

The six numbers are the same for every capture. They were chosen so that on studio and plaza (4 and 2 views) and a
rendered room 60 to 80 % of the errors lie within sigma and 90 % within two (`d2 bench priors`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.priors.extras import opencv

MATCHING = 0.03
"""Error of the best match, pixels."""
PER_COST = 0.15
"""Further error per unit of matching cost 1 - NCC, pixels."""
PER_INCOHERENCE = 5.0
"""Further error where none of the neighbours lies on the same surface, pixels."""
OF_SCATTER = 0.65
"""Share of the scatter about the local plane."""
OF_SPREAD = 0.35
"""Share of the difference to the sources' own depths."""
FLOOR = 7e-4
"""What no map is better than: calibration, resampling, the nearest pixel of a source."""
WINDOW = 7
"""Side of the window of the local plane, pixels."""


def geometric_sigma(
    depth: np.ndarray, cost: np.ndarray, coherence: np.ndarray, parallax: np.ndarray, spread: np.ndarray
) -> np.ndarray:
    """Relative standard deviation of D^g, float32 [H, W]; infinite where there is no depth or no parallax.

    Args:
        depth: D^g [H, W], 0 where there is none.
        cost: matching cost 1 - NCC [H, W], 0 where it is not known.
        coherence: share of the neighbours on the tangent plane [H, W], 0..1.
        parallax: root of the sum over confirming sources of P^2 [H, W], pixels per unit of log depth.
        spread: root mean square relative difference to the depths of the confirming sources [H, W].
    """
    known = (depth > 0) & (parallax > 0)
    pixels = MATCHING + PER_COST * np.maximum(cost, 0) + PER_INCOHERENCE * (1 - np.clip(coherence, 0, 1))
    matching = pixels / np.where(known, parallax, 1)
    scatter = OF_SCATTER * plane_scatter(depth)
    variance = matching**2 + scatter**2 + (OF_SPREAD * spread) ** 2 + FLOOR**2
    return np.where(known, np.sqrt(variance), np.inf).astype(np.float32)


def plane_scatter(depth: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Root mean square relative deviation of inverse depth from the plane fitted to its window, [H, W]; 0 where empty.

    A plane in space is linear in inverse depth over the picture. Sums over the window come from box filters.
    """
    cv2: Any = opencv("the precision of geometric depth")
    known = depth > 0
    if not known.any():
        return np.zeros(depth.shape)
    unit = float(np.median(depth[known]))  # keeps the sums near one whatever the world's unit
    inverse = np.where(known, unit / np.where(known, depth, 1), 0).astype(np.float64)
    weight = known.astype(np.float64)
    rows, columns = (axis - axis.mean() for axis in np.indices(depth.shape, dtype=np.float64))

    def total(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)

    def mean(values: np.ndarray) -> np.ndarray:
        return total(values) / count

    count = np.maximum(total(weight), 1)
    # Moments about the window's own pixel would need a loop over windows; those about the picture's middle do not.
    u, v, y = mean(weight * columns), mean(weight * rows), mean(inverse)
    uu, vv = mean(weight * columns**2) - u * u, mean(weight * rows**2) - v * v
    uv, yy = mean(weight * rows * columns) - u * v, mean(inverse**2) - y * y
    uy, vy = mean(inverse * columns) - u * y, mean(inverse * rows) - v * y
    uu, vv = uu + 1e-3, vv + 1e-3  # a window of one row or one pixel has no slope across it
    determinant = uu * vv - uv * uv
    explained = (vv * uy * uy - 2 * uv * uy * vy + uu * vy * vy) / determinant
    return np.where(known, np.sqrt(np.maximum(yy - explained, 0)) / np.where(known, inverse, 1), 0)

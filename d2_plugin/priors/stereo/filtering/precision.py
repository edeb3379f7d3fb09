"""How precise a geometric depth is: matching precision through the parallax, and what neighbours and sources say.

A match that is off by e pixels puts the depth off by e / P, where P is the parallax: by how many pixels the match moves
in the confirming sources when the depth changes by its own size. The match itself is as sharp as the picture is: grey
values that are off by n put it off by n / g where they change by g per pixel. Two things that a map knows about itself
tell where that is too good: how far depths scatter about the plane of their neighbours, and how far the depth of a
confirming source lies from ours.

    sigma^2 = ((m + n / g + k (1 - coherence)) / P)^2 + (r scatter)^2 + (s spread)^2 + floor^2

What the match cost says is in the other terms already: a fit gives it no weight. The numbers are the same for every
capture. They are a fit to studio and plaza (4 and 2 views), rendered rooms and Middlebury pairs (art, laundry,
motorcycle, teddy): the table of docs/priors.md says what share of the errors they hold.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.priors.extras import opencv

MATCHING = 0.00293
"""Error of the best match, pixels: next to nothing, what it is worth is told by the gradient."""
GRAY_NOISE = 1.3e-3
"""Error of the grey values (0..1) that a match compares: noise, exposure, resampling."""
PER_INCOHERENCE = 2.83
"""Further error where none of the neighbours lies on the same surface, pixels."""
OF_SCATTER = 0.83
"""Times the scatter about the local plane."""
OF_SPREAD = 0.4
"""Share of the difference to the sources' own depths."""
FLOOR = 8.1e-4
"""What no map is better than: calibration, resampling, the nearest pixel of a source."""
FLATTEST = 3e-3
"""Gradients of the grey value are not told from noise below this, per pixel."""
BLUR, AROUND = 0.7, 9
"""Blur before the gradient is taken, pixels, and side of the window over which it is averaged."""
WINDOW = 7
"""Side of the window of the local plane, pixels."""


def geometric_sigma(
    depth: np.ndarray,
    coherence: np.ndarray,
    parallax: np.ndarray,
    spread: np.ndarray,
    gradient: np.ndarray,
) -> np.ndarray:
    """Relative standard deviation of D^g, float32 [H, W]; infinite where there is no depth or no parallax.

    NaN in any of the maps says that nothing is known of the pixel, so its sigma is infinite too.

    Args:
        depth: D^g [H, W], 0 where there is none.
        coherence: share of the neighbours on the tangent plane [H, W], 0..1.
        parallax: root of the sum over confirming sources of P^2 [H, W], pixels per unit of log depth.
        spread: root mean square relative difference to the depths of the confirming sources [H, W].
        gradient: change of the grey value around the pixel [H, W], 0..1 per pixel (see `grey_gradient`).
    """
    known = (depth > 0) & (parallax > 0) & np.isfinite(depth) & ~np.isnan(coherence)
    known &= np.isfinite(spread) & ~np.isnan(gradient)
    coherence, spread = (np.where(known, map_, 0) for map_ in (coherence, spread))
    pixels = MATCHING + GRAY_NOISE / np.where(known, np.maximum(gradient, FLATTEST), 1)
    pixels = pixels + PER_INCOHERENCE * (1 - np.clip(coherence, 0, 1))
    matching = pixels / np.where(known, parallax, 1)
    scatter = OF_SCATTER * plane_scatter(np.where(np.isfinite(depth), depth, 0))
    variance = matching**2 + scatter**2 + (OF_SPREAD * spread) ** 2 + FLOOR**2
    return np.where(known, np.sqrt(variance), np.inf).astype(np.float32)


def grey_gradient(gray: np.ndarray) -> np.ndarray:
    """Root mean square change of the grey value around each pixel of uint8 [H, W], float32 [H, W], 0..1 per pixel."""
    cv2: Any = opencv("the precision of geometric depth")
    smooth = cv2.GaussianBlur(gray.astype(np.float32) / 255, (0, 0), BLUR)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    # Running sums of float32 end a hair below zero beside strong edges.
    return np.sqrt(np.maximum(cv2.blur(across * across + down * down, (AROUND, AROUND)), 0))


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
    uu, vv = uu + 1e-6, vv + 1e-6  # a window of one row or one pixel has no slope across it
    determinant = uu * vv - uv * uv
    explained = (vv * uy * uy - 2 * uv * uy * vy + uu * vy * vy) / determinant
    return np.where(known, np.sqrt(np.maximum(yy - explained, 0)) / np.where(known, inverse, 1), 0)

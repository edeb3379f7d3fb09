"""How precise a geometric depth is: matching precision through the parallax, neighbours and confirming sources.

A match that is off by e pixels puts the depth off by e / P, where P is the parallax: by how many pixels the match moves
in the confirming sources when the depth changes by its own size. The match itself is as sharp as the image is: grey
values that are off by n put it off by n / g where they change by g per pixel. Two things that a map knows about itself
tell where that is too good: how far depths scatter about the plane of their neighbours, and how far the depth of a
confirming source lies from ours.

    sigma^2 = ((m + n / g + k (1 - coherence)) / P)^2 + (r scatter)^2 + (s spread)^2 + floor^2

What the match cost says is in the other terms already: a fit gives it no weight. The numbers are the same for every
recording. They are a fit to studio and plaza (4 and 2 views), rendered rooms and Middlebury pairs (art, laundry,
motorcycle, teddy): the table of docs/priors.md says what share of the errors they hold.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.recordings.images import opencv

MATCHING = 0.00293
"""Error of the best match, pixels: next to nothing; the gradient decides."""
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
SLACK = 1e-6
"""Added to the second moments of the window, pixels^2: a window of one row or one pixel has no slope across it."""


def geometric_sigma(
    depth: np.ndarray,
    coherence: np.ndarray,
    parallax: np.ndarray,
    spread: np.ndarray,
    gradient: np.ndarray,
) -> np.ndarray:
    """Relative standard deviation of D^g, float32 [H, W]; infinite where there is no depth or no parallax.

    NaN in any of the maps means that nothing is known of the pixel, so its sigma is infinite too.

    Args:
        depth: D^g [H, W], 0 where there is none.
        coherence: share of the neighbours on the tangent plane [H, W], 0..1.
        parallax: root of the sum over confirming sources of P^2 [H, W], pixels per unit of log depth.
        spread: root mean square relative difference to the depths of the confirming sources [H, W].
        gradient: change of the grey value around the pixel [H, W], 0..1 per pixel (see `grey_gradient`).
    """
    maps: dict[str, np.ndarray] = {
        "depth": np.ascontiguousarray(depth, np.float32),
        "coherence": np.ascontiguousarray(coherence, np.float32),
        "gradient": np.ascontiguousarray(gradient, np.float32),
        "parallax": np.ascontiguousarray(parallax, np.float64),
        "spread": np.ascontiguousarray(spread, np.float64),
        "scatter": plane_scatter(depth),
        "sigma": np.empty(depth.shape, np.float32),
    }
    numbers = {"matching": MATCHING, "gray_noise": GRAY_NOISE, "flattest": FLATTEST, "per_incoherence": PER_INCOHERENCE}
    kernel.run("sigma", maps, **numbers, of_scatter=OF_SCATTER, of_spread=OF_SPREAD, floor_squared=FLOOR**2)
    return maps["sigma"]


def grey_gradient(gray: np.ndarray) -> np.ndarray:
    """Root mean square change of the grey value around each pixel of uint8 [H, W], float32 [H, W], 0..1 per pixel."""
    cv2: Any = opencv("the precision of geometric depth")
    smooth = cv2.GaussianBlur(gray.astype(np.float32) / 255, (0, 0), BLUR)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    # Running sums of float32 end a hair below zero beside strong edges.
    return np.sqrt(np.maximum(cv2.blur(across * across + down * down, (AROUND, AROUND)), 0))


def plane_scatter(depth: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Root mean square relative deviation of inverse depth from the plane fitted to its window, [H, W]; 0 where empty.

    A plane in space is linear in inverse depth over the image.

    Args:
        depth: [H, W], read as float32; 0, infinite or NaN where there is none.
        window: side of the window, pixels, odd.
    """
    depth, scatter = np.ascontiguousarray(depth, np.float32), np.empty(depth.shape)
    kernel.run("scatter", {"depth": depth, "scatter": scatter}, reach=window // 2, slack=SLACK)
    return scatter

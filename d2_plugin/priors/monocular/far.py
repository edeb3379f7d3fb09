"""Sky and whatever else lies beyond any parallax; an addition to the paper.

A sky is where four things come together: the monocular map puts it beyond the farthest depth that stereo measured,
near the smallest value it has in the image; no stereo depth lies in it; the image is smooth there; and it reaches
the rim. From pixels where the first holds clearly, the region grows to the outline that blurred maps give to it, as far
as the colour is that of the sky beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.recordings.images import opencv

CLEARLY = 0.4
"""Inverse depth, in units of that of the farthest anchors, below which a pixel is clearly beyond."""
PERHAPS = 0.9
"""And below which it may be."""
SMOOTH = 0.04
"""Largest standard deviation of the grey value (0..1) within 5x5 pixels of a sky."""
COLOR = 0.06
"""Largest distance of a colour (RGB, 0..1) from the mean sky around it."""
LEAST = 0.005
"""Smallest share of the image that a sky has."""
AROUND = 0.04
"""Reach of "around", image widths."""


def far_pixels(inverse: np.ndarray, geometric: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Where the view sees beyond any parallax, bool [H, W].

    Args:
        inverse: aligned inverse depth of the monocular map [H, W]; 0 and below are infinitely far, NaN unknown.
        geometric: D^g [H, W], 0 where there is none.
        image: RGB uint8 [H, W, 3].
    """
    anchors = geometric[geometric > 0]
    if anchors.size == 0:
        return np.zeros(geometric.shape, bool)
    cv2: Any = opencv("finding the sky")
    farthest = float(np.quantile(anchors, 0.995))
    if np.fmin.reduce(inverse, axis=None) * farthest >= CLEARLY:
        return np.zeros(geometric.shape, bool)
    beyond = np.where(np.isfinite(inverse), inverse, np.inf) * farthest
    if np.count_nonzero(beyond < CLEARLY) < LEAST * beyond.size:
        return np.zeros(geometric.shape, bool)
    measured = cv2.dilate((geometric > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    red, green, blue = cv2.split(image)
    gray = (cv2.add(cv2.add(red, green, dtype=cv2.CV_16U), blue, dtype=cv2.CV_16U) / np.float32(3)) / 255
    mean = cv2.blur(gray, (5, 5))
    smooth = np.sqrt(np.maximum(cv2.blur(gray * gray, (5, 5)) - mean * mean, 0)) < SMOOTH
    clear = _large(cv2, (beyond < CLEARLY) & smooth & ~measured)
    if not clear.any():
        return clear
    colored = _like_around(cv2, image.astype(np.float32) / 255, clear)
    candidates = (clear | ((beyond < PERHAPS) & colored)) & ~measured
    _, pieces = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    return np.isin(pieces, np.unique(pieces[clear]))


def _large(cv2: Any, mask: np.ndarray) -> np.ndarray:
    """The connected pieces that are large enough and reach the rim of the image."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    left, top, width, height, area = stats.T
    at_rim = (left == 0) | (top == 0) | (left + width == mask.shape[1]) | (top + height == mask.shape[0])
    keep = (area >= LEAST * mask.size) & at_rim
    keep[0] = False
    return keep[pieces]


def _like_around(cv2: Any, image: np.ndarray, clear: np.ndarray) -> np.ndarray:
    sigma = AROUND * clear.shape[1]
    weight = cv2.GaussianBlur(clear.astype(np.float32), (0, 0), sigma)
    mean = cv2.GaussianBlur(image * clear[..., None], (0, 0), sigma) / np.maximum(weight, 1e-6)[..., None]
    red, green, blue = np.moveaxis(image - mean, -1, 0)
    return (weight > 1e-3) & (red * red + green * green + blue * blue < COLOR**2)

"""Medians and quantiles of vectors, each by a partition around one place.

NumPy has that one compiled for vectors of numbers; its own median and quantile look for several places at once and take
several times as long.
"""

from __future__ import annotations

import math

import numpy as np


def median(values: np.ndarray) -> float:
    """The median of numbers [n], n > 0; NaN where one is NaN."""
    middle = values.size // 2
    low, high = _neighbours(values, middle - 1 + values.size % 2)
    return float((low + high) / 2) if values.size % 2 == 0 else float(low)


def quantile(values: np.ndarray, share: float) -> float:
    """The quantile of numbers [n], n > 0, linear between two of them; NaN where one is NaN."""
    place = share * (values.size - 1)
    before = min(math.floor(place), values.size - 1)
    low, high = _neighbours(values, before)
    return float(low) if place == before else float(low) + (float(high) - float(low)) * (place - before)


def _neighbours(values: np.ndarray, place: int) -> tuple[np.floating, np.floating]:
    """The numbers that a sort would bring to a place and to the next; the same one twice at the end."""
    after = min(place + 1, values.size - 1)
    parted = np.partition(values, after)
    high = parted[after]
    low = parted[:after].max() if after > place else high
    if np.isnan(parted[after:].max()):  # NaN are sorted to the end
        return parted.dtype.type(np.nan), parted.dtype.type(np.nan)
    return low, high

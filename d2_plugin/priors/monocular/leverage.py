"""A guard against wrong anchors that every convex fit would follow: only those near the best line are fitted."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np


class Selection(NamedTuple):
    """Anchors near one line, bool [N], and by how many standard deviations they are more than chance.

    Anchors that were chosen to fit a line say nothing about whether there is one. Chance is how many would lie as near
    if the map were shuffled.
    """

    keep: np.ndarray
    t: float


def near_best_line(
    x: np.ndarray, y: np.ndarray, weights: np.ndarray, share: float, seed: int, trials: int = 200, probes: int = 500
) -> Selection:
    """Anchors near the rising line through two random ones that passes nearest to the best `share` of all anchors.

    Least quantile of squares (Rousseeuw and Leroy 1987): it stands wrong anchors up to 1 - `share`, where the median
    breaks at a half. Near is within 2.5 standard deviations, as that quantile tells them for normal residuals.
    """
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, x.size, (2, trials))
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = (y[first] - y[second]) / (x[first] - x[second])
    rising = np.isfinite(scales) & (scales > 0)
    if not rising.any():
        return Selection(np.ones(x.size, bool), 0.0)
    scales, shifts = scales[rising], y[first[rising]] - scales[rising] * x[first[rising]]
    probe = rng.integers(0, x.size, min(x.size, probes))
    residuals = np.abs(scales[:, None] * x[probe] + shifts[:, None] - y[probe]) * weights[probe]
    place = min(int(share * probe.size), probe.size - 1)
    quantiles = np.partition(residuals, place, axis=1)[:, place]
    best = quantiles.argmin()
    reach = 2.5 * quantiles[best] / NormalDist().inv_cdf((1 + share) / 2)

    def near(mono: np.ndarray) -> np.ndarray:
        return np.abs(scales[best] * mono + shifts[best] - y) * weights <= reach

    keep, chance = near(x), float(near(rng.permutation(x)).mean())
    spread = np.sqrt(max(chance * (1 - chance), 1 / x.size) / x.size)
    return Selection(keep if keep.sum() >= 2 else np.ones(x.size, bool), float(keep.mean() - chance) / spread)

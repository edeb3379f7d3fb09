"""How far the line that aligns a map may be off beyond the depths that its anchors have.

A pair of cameras measures what is near, and the line that its anchors give is drawn on to what is far. Left-out
regions do not show what that may cost: they lie within the range of depths that the others have. So the line is fitted
without the nearest and without the farthest third of the anchors: how far those two part from the line of all of them
is its error.
"""

from __future__ import annotations

import numpy as np

from d2_plugin.priors.monocular.align import unjudged_line
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.recordings.recording import MonoKind

THIRD = 1 / 3
"""Share of the anchors that are left out, the nearest or the farthest."""
RANGE = (0.02, 0.98)
"""Quantiles of the anchors' depths between which a map does not extrapolate."""


def extrapolation_error(
    aligned: np.ndarray, anchors: np.ndarray, kind: MonoKind, settings: AlignSettings
) -> np.ndarray:
    """Relative standard deviation of the line beyond the anchors' depths, [H, W]; 0 between them.

        S(D)^2 = (1 - q) / q sum over both thirds of (log D_k(D) / D  -  log D_k(C) / C)^2

    with D_k the depth that the line fitted without a third gives where all anchors give D, and C the nearest depth to D
    that the anchors have: how far the lines part on the way from there; (1 - q) / q is the factor of a jackknife that
    leaves out the share q = 1/3. Infinite where a line ends before it reaches D.

    Args:
        aligned: aligned monocular depth [H, W], 0 where it has none.
        anchors: D^g [H, W], 0 where there are none.
        kind: what the map was before: relative ones are lines in inverse depth.
    """
    known = (anchors > 0) & (aligned > 0)
    if not known.any():
        return np.zeros(aligned.shape)
    depth = np.where(aligned > 0, aligned, float(np.median(aligned[known]))).astype(np.float64)
    held = np.clip(depth, float(np.quantile(depth[known], RANGE[0])), float(np.quantile(depth[known], RANGE[1])))
    near, far = (float(np.quantile(anchors[known], share)) for share in (THIRD, 1 - THIRD))
    error, beyond = np.zeros(aligned.shape), np.flatnonzero(depth != held)
    parted = []
    for rest in (anchors > near, anchors < far):
        others = np.where(rest, anchors, 0)
        line = unjudged_line(1 / depth if kind == "relative" else depth, others, kind=kind, settings=settings)
        parted.append(_parted(depth.ravel()[beyond], held.ravel()[beyond], *line, kind))
    error.ravel()[beyond] = np.sqrt((1 - THIRD) / THIRD) * np.hypot(*parted)
    return error


def _parted(depth: np.ndarray, held: np.ndarray, scale: float, shift: float, kind: MonoKind) -> np.ndarray:
    """|log| [n] by which a line and that of all anchors part between `held` and `depth`."""
    if not scale > 0:
        return np.full(depth.shape, np.inf)
    sign = -1 if kind == "relative" else 1
    ratios = []
    for place in (depth, held):
        value = place**sign
        moved = (scale * value + shift) / value
        ratios.append(np.where(moved > 0, np.log(np.where(moved > 0, moved, 1)), np.nan))
    return np.nan_to_num(np.abs(ratios[0] - ratios[1]), nan=np.inf)

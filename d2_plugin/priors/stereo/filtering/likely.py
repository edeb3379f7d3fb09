"""Matches that the filter of geometric depth refuses and that are likely right nevertheless."""

from __future__ import annotations

import numpy as np

from d2_plugin.recordings.images import opencv

LOOSER = 2.0
"""Unfiltered depths of two views agree within so many times the filter's tolerance."""
NEARBY = 41
"""Side of the window whose kept depths a match is compared with, pixels."""
LEAST = 41
"""Kept depths in that window below which it says nothing."""
BIAS, COHERENT, SEEN, APART = -3.1, 4.8, 1.1, -0.32
"""Logarithm of the odds that a match is within 2 %: at 0, by coherence, by each view that agrees, by the logarithm of
the distance from what is kept. Fitted to studio and plaza, four and two views (docs/evidence.md)."""
SIGMA = np.float32(0.02)
"""Relative standard deviation of a likely match: right ones are closer, and one in ten is not right."""
EXACT = 0.002
"""Distances below this are the same."""
ODDS = float(np.log(0.7 / 0.3))
"""A match is likely where they are better than seven to three."""


def are_likely(matches: np.ndarray, kept: np.ndarray, coherence: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Which of the unfiltered `matches` are likely right although they are not `kept`, bool [H, W].

    Args:
        matches, kept: planar depth float32 [H, W], 0 where there is none, before and after the filter.
        coherence: share of neighbours on one surface, 0..1 [H, W].
        sources: how many other views agree, [H, W].
    """
    apart = np.log(EXACT + distance_from_kept(matches, kept))
    odds = BIAS + COHERENT * coherence + SEEN * sources + APART * apart
    return (matches > 0) & (kept == 0) & (sources > 0) & (odds >= ODDS)


def distance_from_kept(matches: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """How far a match is from the mean inverse of the depths kept around it, in logarithms [H, W]; 1 where few are."""
    cv2 = opencv("the filter of geometric depth")
    known = kept > 0

    def around(map_: np.ndarray) -> np.ndarray:
        options = {"normalize": False, "borderType": cv2.BORDER_CONSTANT}
        return cv2.boxFilter(map_.astype(np.float64), cv2.CV_64F, (NEARBY, NEARBY), **options)

    count = around(known)
    ratio = matches * around(np.divide(1, kept, out=np.zeros_like(kept), where=known)) / np.fmax(count, 1)
    compared = (count >= LEAST) & (ratio > 0)
    return np.where(compared, np.abs(np.log(np.where(compared, ratio, 1))), 1)

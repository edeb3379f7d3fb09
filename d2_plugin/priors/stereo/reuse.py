"""Reuse: matches are carried from frame to frame where the image did not change.

Matching takes nearly all of the time, and in a room with fixed cameras most pixels look the same from one frame to the
next. Where a pixel's neighbourhood has not changed since its depth was matched, raw depth and cost are carried over;
the others are matched anew. The filter then runs on the whole maps of the frame, so a carried depth counts only while
some other view, as it is now, still confirms it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from d2_plugin.recordings.images import opencv

SMOOTHING = 3  # side of the box over which a change is averaged, pixels: noise cancels, moving things do not
MEMORY_DTYPE = np.dtype([("gray", "u1"), ("depth", "<f4"), ("cost", "<f4")])

CHANGE = 12 / 255
"""Change of the grey value (0..1, mean of 3x3 pixels) above which a pixel is matched anew."""
RADIUS = 6
"""Pixels this near to a change are matched anew too: the matching window reaches that far."""
MARGIN = 4
"""Pixels this near to those are matched with them, to hand over good planes, but not taken."""


@dataclass(eq=False)
class MatchMemory:
    """Per view what was matched last, pixel by pixel, and the grey value it was matched with."""

    views: list[np.ndarray] = field(default_factory=list)  # MEMORY_DTYPE [H, W] per view
    matched_share: float = 0.0

    def wanted(self, grays: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """Pixels that must be matched anew, bool [H, W] per view; None where nothing is remembered yet."""
        if not self.views:
            return None
        return [changed(gray, view["gray"]) for gray, view in zip(grays, self.views)]

    def merge(
        self,
        grays: Sequence[np.ndarray],
        raw: Sequence[tuple[np.ndarray, np.ndarray]],
        wanted: Sequence[np.ndarray] | None,
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Take in what was matched at the wanted pixels; returns whole maps of depth and cost."""
        if wanted is None:
            wanted = [np.ones(gray.shape, bool) for gray in grays]
            self.views = [np.zeros(gray.shape, MEMORY_DTYPE) for gray in grays]
        for view, gray, (depth, cost), mask in zip(self.views, grays, raw, wanted):
            view["gray"][mask], view["depth"][mask], view["cost"][mask] = gray[mask], depth[mask], cost[mask]
        self.matched_share = float(np.mean([mask.mean() for mask in wanted]))
        return [(view["depth"].copy(), view["cost"].copy()) for view in self.views]


def changed(gray: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Pixels in whose neighbourhood the image changed, bool [H, W]."""
    cv2 = opencv("reusing matches of static pixels")
    difference = cv2.blur(gray.astype(np.float32) - before, (SMOOTHING, SMOOTHING))
    return widened(np.abs(difference) > 255 * CHANGE, RADIUS)


def widened(mask: np.ndarray, radius: int) -> np.ndarray:
    """The mask and everything within a square of `radius` pixels around it."""
    cv2 = opencv("reusing matches of static pixels")
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0

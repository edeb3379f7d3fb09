"""The shape that errors of corrected monocular maps follow, the same in every recording (`uncertainty`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from d2_plugin.priors.extras import opencv
from d2_plugin.priors.monocular.order import median

FLOOR, DISTANCE, GAP, EDGE, WIDE_EDGE, BEYOND = 0.051, 1.19, 0.79, 2.76, 0.16, 0.086
"""f0 and fd (of d itself) to fr; fitted once to the true errors of studio, plaza and a rendered room together."""
NEXT = 0.003
"""How far the next anchor lies where a pixel's own is left out, image widths."""
EVER = 1e3
"""Beyond any logarithm of a float32 depth: neutral in a minimum or, negated, in a maximum."""


@dataclass(frozen=True, eq=False)
class ErrorShape:
    """Squares of the terms of the shape [H, W] float32, or of some of its pixels [n]."""

    distance: np.ndarray
    gap: np.ndarray
    own: tuple[np.ndarray, ...]
    """Those that do not depend on the next anchor: edges, and what lies beyond the median anchor."""
    next_distance: np.ndarray
    """What `distance` is, [1], where the pixel's own anchor was left out."""

    @classmethod
    def of(cls, depth: np.ndarray, anchors: np.ndarray, at: np.ndarray | None = None) -> ErrorShape:
        """The terms of a corrected map.

        Args:
            depth: the corrected map [H, W].
            anchors: D^g [H, W], 0 where there is none.
            at: flat indices [n] of some pixels; all where None.
        """

        def chosen(values: np.ndarray) -> np.ndarray:
            return values if at is None else values.ravel()[at]

        cv2: Any = opencv("the uncertainty of monocular depth")
        known, predicted = anchors > 0, depth > 0
        width = depth.shape[1]
        log_depth = np.log(np.where(predicted, depth, 1)).astype(np.float32)
        log_anchors = np.log(anchors[known]).astype(np.float32)
        distance, label = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        by_label = np.zeros(int(label.max()) + 1, np.float32)
        by_label[label[known]] = log_anchors
        gap = np.abs(chosen(log_depth) - by_label[chosen(label)])
        beyond = np.maximum(chosen(log_depth) - np.float32(median(log_anchors)), 0)
        nowhere_above = np.where(predicted, log_depth, np.float32(-EVER))
        nowhere_below = np.where(predicted, log_depth, np.float32(EVER))
        edge, wide_edge = (
            _span(*(chosen(far) for far in _farthest(cv2, nowhere_above, nowhere_below, share * width)))
            for share in (0.005, 0.02)
        )
        own = (EDGE * np.minimum(edge, 0.7)) ** 2, (WIDE_EDGE * np.minimum(wide_edge, 1)) ** 2, (BEYOND * beyond) ** 2
        next_distance = np.full(1, NEXT * width, np.float32)
        squares = (DISTANCE**2 * np.minimum(far / width, 0.3) for far in (chosen(distance), next_distance))
        return cls(next(squares), (GAP * np.minimum(gap, 0.6)) ** 2, own, next(squares))

    def usual(self) -> np.ndarray:
        """The shape, up to the scale."""
        return np.sqrt(sum(self.own, FLOOR**2 + self.distance + self.gap))

    def left_out(self) -> np.ndarray:
        """The same if each pixel's own anchor had been left out: the next one is `NEXT` away, and nothing is known of
        how far the depth lies from it."""
        return np.sqrt(sum(self.own, FLOOR**2 + self.next_distance))


def _farthest(cv2: Any, above: np.ndarray, below: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Largest of `above` and smallest of `below` [H, W] within a square of that radius, pixels."""
    side = 2 * max(1, round(radius)) + 1
    kernel = np.ones((side, side), np.uint8)
    return cv2.dilate(above, kernel), cv2.erode(below, kernel)


def _span(largest: np.ndarray, smallest: np.ndarray) -> np.ndarray:
    """Largest minus smallest; 0 where there is neither."""
    return np.where(largest < smallest, 0, largest - smallest)

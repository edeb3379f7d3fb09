"""How wrong a monocular depth may be, measured by leaving regions of anchors out.

The residual at an anchor says nothing: the anchor shaped the map that it is compared with. So regions of anchors are
left out of the local correction, and the corrected map is held against them. Their errors follow one shape in every
recording measured: they grow with the distance to the nearest anchor, with how far the depth lies from that anchor's
(the map extrapolates), and at the edges of the map. How large they are differs from network to network and from
image to image; that one number, the scale, is measured in each image.

    sigma^2 = (K scale)^2 (f0^2 + fd^2 d + (fg g)^2 + (fe e)^2 + (fw e')^2 + (fr r)^2) + S(D)^2

with d the distance to the nearest anchor (image widths), g = |log(D / D of that anchor)|, e and e' the span of log D
within 0.5 % and 2 % of the width, r = log(D / median anchor) where it is positive, and S how far the line may be off
beyond the depths of the anchors (`extrapolation`). A pixel without an anchor is harder than an anchor that was left out
(no texture, an edge, seen once): K = 1.25.

A map that mostly holds but is far off at some things (a weak network) shows it in the tail of these errors, and the
things it misses are those without anchors: the 98 % quantile, where it goes beyond the usual, enlarges all its sigma.

Where a constant map, bent by the same anchors, is clearly nearer to those left out, the map adds nothing: its sigma is
infinite, so that it may propose and no more.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.priors.maps_on_disk import divided
from d2_plugin.priors.monocular.correct import corrected_depth, corrected_without
from d2_plugin.priors.monocular.extrapolation import extrapolation_error
from d2_plugin.priors.settings import AlignSettings
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import MonoKind

HARDER = 1.25
"""K of a pixel without an anchor."""
AT_ANCHORS = 1.25
"""K of a pixel that is compared with its anchor."""
WIDTH = 160
"""Columns of the image at which all this is computed: its terms are in image widths."""
PATTERNS, REGIONS = 6, 4
"""How often regions are left out, and how many at a time."""
COMPARED = 3
"""Patterns in which the map is also compared with no network at all."""
SMALLEST, LARGEST = 0.05, 0.6
"""Sides of the regions, image widths; drawn evenly in their logarithm."""
NIL = 0.8
"""A map whose errors are larger than a constant one's by this factor adds nothing."""
LEAST = 200
"""With fewer left-out anchors in all, the scale is not known."""
USUAL, EVIDENCE = 0.12, 3000
"""The scale of most maps, and how many anchors (at `WIDTH`) weigh as much: a few that lie together are held from near
by, and do not make a map surer than usual."""
TRUE = 1e-9
"""The scale of a map without any error: not 0, which its tail is divided by."""
IN_TAIL, USUAL_TAIL = 0.98, 3.0
"""A quantile far out, and where it lies in maps that belong to their images, in units of the scale (2.33 if errors
were normal)."""
HOPELESS = 0.5
"""A larger sigma says nothing about depth: it becomes infinite."""

FLOOR, DISTANCE, GAP, EDGE, WIDE_EDGE, BEYOND = 0.051, 1.19, 0.79, 2.76, 0.16, 0.086
"""f0 and fd (of d itself) to fr; fitted once to the true errors of studio, plaza and a rendered room together."""
NEXT = 0.003
"""How far the next anchor lies where a pixel's own is left out, image widths."""
EVER = 1e3
"""Beyond any logarithm of a float32 depth: neutral in a minimum or, negated, in a maximum."""


class Skill(NamedTuple):
    """What left-out anchors say about one map."""

    scale: float
    """How large its errors are, in units of their common shape; NaN where too few anchors could be left out."""
    error: float
    """Median of |log(map / anchor)| over left-out anchors."""
    gain: float
    """Median error of a constant map corrected by the same anchors over that of the map, at the same left-out anchors;
    the map says nothing where it is not above `NIL`."""
    tail: float
    """How much farther than usual the tail of its errors goes, 1 at least."""

    @property
    def nil(self) -> bool:
        """Whether the map says no more than the anchors alone."""
        return self.gain <= NIL

    def as_json(self) -> dict[str, float | None]:
        """Plain values for the record beside a stored prior; NaN becomes None."""
        return {name: value if np.isfinite(value) else None for name, value in self._asdict().items()}


class Uncertainty(NamedTuple):
    """How wrong a corrected monocular map may be; maps [H, W] float32, infinite where that is unknown."""

    sigma: np.ndarray
    """Relative standard deviation where the map stands alone."""
    at_anchors: np.ndarray
    """The same if the pixel's own anchor had not shaped the map: what verification compares with."""
    skill: Skill


def monocular_uncertainty(
    aligned: np.ndarray,
    geometric: np.ndarray,
    settings: AlignSettings,
    confidence: np.ndarray | None = None,
    kind: MonoKind | None = "relative",
) -> Uncertainty:
    """How wrong the corrected map may be, from the anchors that can be left out.

    Args:
        aligned: aligned monocular depth before local correction [H, W], 0 where it has none.
        geometric: D^g, the anchors [H, W], 0 where there are none.
        confidence: the map's own, in any unit [H, W]: errors are spread as 1 / confidence besides, and how large they
            are is measured as ever. None is 1 everywhere.
        kind: what the map is: its line is one in inverse depth or in depth. None is a map known up to a scale, which
            has no line to draw on.
    """
    small, anchors = _shrunk(aligned), _shrunk(geometric)
    sure = None if confidence is None else _relative(_shrunk(confidence))
    skill = measured_skill(small, anchors, settings, sure)
    unknown = np.full(aligned.shape, np.inf, np.float32)
    if not np.isfinite(skill.scale):
        return Uncertainty(unknown, unknown, skill)
    corrected = corrected_depth(small, anchors, settings)
    usual, without_own = error_shape(corrected, anchors)
    between = HARDER * skill.tail * skill.scale * divided(usual, sure)
    beyond = 0.0 if kind is None else extrapolation_error(small, anchors, kind, settings)
    sigma = _enlarged(np.hypot(between, beyond), aligned.shape)
    left_out = AT_ANCHORS * skill.tail * skill.scale * divided(without_own, sure)
    at_anchors = _enlarged(left_out, aligned.shape)
    usable = (aligned > 0) & (sigma < HOPELESS) & (not skill.nil)
    return Uncertainty(np.where(usable, sigma, np.float32(np.inf)), at_anchors, skill)


def measured_skill(
    aligned: np.ndarray, anchors: np.ndarray, settings: AlignSettings, confidence: np.ndarray | None
) -> Skill:
    """Errors at anchors [H, W] that were left out of the correction of `aligned` [H, W]."""
    holes, both = left_out_regions(anchors.shape), (anchors > 0) & (aligned > 0)
    held, rest = holes & both, ~holes & (anchors > 0)
    left_out, others = (np.count_nonzero(masks, axis=(1, 2)) for masks in (held, rest))
    enough = (left_out >= 20) & (others >= max(settings.min_anchors, 1))
    if left_out[enough].sum() < LEAST:
        return Skill(np.nan, np.nan, np.nan, np.nan)
    holes, rest = holes[enough], rest[enough]
    corrected = corrected_without(aligned, anchors, holes, settings)
    ratios, errors = [], []
    places = [np.flatnonzero(mask) for mask in held[enough]]
    for place, depth, others in zip(places, corrected, rest):
        shape, _ = error_shape(depth, np.where(others, anchors, 0), place)
        errors.append(_log_error(depth, anchors, place))
        ratios.append(errors[-1] / divided(shape, None if confidence is None else confidence.ravel()[place]))
    # The map was aligned to all anchors, those left out among them: so the constant is the median of all.
    constant = np.full(anchors.shape, np.median(anchors[anchors > 0]), np.float32)
    flat = corrected_without(constant, anchors, holes[:COMPARED], settings)
    without = [_log_error(depth, anchors, place) for depth, place in zip(flat, places)]
    compared, alone = (float(np.median(np.concatenate(each))) for each in (errors[:COMPARED], without))
    all_ratios, error = np.concatenate(ratios), float(np.median(np.concatenate(errors)))
    scale = _scale(all_ratios, int(np.count_nonzero(anchors)))
    # How far errors in units of their shape go beyond the usual ones of that scale.
    tail = float(max(np.quantile(all_ratios, IN_TAIL) / (USUAL_TAIL * scale), 1))
    return Skill(scale, error, alone / max(compared, np.finfo(float).tiny), tail)


def error_shape(depth: np.ndarray, anchors: np.ndarray, at: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The shape of the errors of a corrected map up to its scale: as it is, and with each pixel's own anchor left out.

    Without it the next anchor is `NEXT` away, and nothing is known of how far the depth lies from that one's.

    Args:
        depth: the corrected map [H, W].
        anchors: D^g [H, W], 0 where there is none.
        at: flat indices [n] of the pixels that are wanted; all where None.

    Returns:
        Twice float32 [H, W], or [n].
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
    beyond = np.maximum(chosen(log_depth) - np.median(log_anchors), 0)
    nowhere_above = np.where(predicted, log_depth, np.float32(-EVER))
    nowhere_below = np.where(predicted, log_depth, np.float32(EVER))

    def spanned(share: float) -> np.ndarray:
        """Span of log depth within a square of that share of the width around each pixel; 0 where there is none."""
        side = 2 * max(1, round(share * width)) + 1
        kernel = np.ones((side, side), np.uint8)
        largest, smallest = chosen(cv2.dilate(nowhere_above, kernel)), chosen(cv2.erode(nowhere_below, kernel))
        return np.where(largest < smallest, 0, largest - smallest)

    edge, wide_edge = spanned(0.005), spanned(0.02)
    own = (EDGE * np.minimum(edge, 0.7)) ** 2, (WIDE_EDGE * np.minimum(wide_edge, 1)) ** 2, (BEYOND * beyond) ** 2
    near, next_near = (
        DISTANCE**2 * np.minimum(far / width, 0.3) for far in (chosen(distance), np.full(1, NEXT * width, np.float32))
    )
    usual = np.sqrt(sum(own, FLOOR**2 + near + (GAP * np.minimum(gap, 0.6)) ** 2))
    return usual, np.sqrt(sum(own, FLOOR**2 + next_near))


def _log_error(depth: np.ndarray, anchors: np.ndarray, place: np.ndarray) -> np.ndarray:
    """|log(depth / anchor)| [n] at pixels that are given by flat index."""
    return np.abs(np.log(depth.ravel()[place] / anchors.ravel()[place]))


def _scale(ratios: np.ndarray, anchors: int) -> float:
    """The 68 % quantile of errors in units of their shape, from few anchors not below what is usual."""
    measured = max(float(np.quantile(ratios, 0.68)), TRUE)
    share = anchors / (anchors + EVIDENCE)
    return float(max(measured, measured**share * USUAL ** (1 - share)))


@functools.cache
def left_out_regions(shape: tuple[int, int]) -> np.ndarray:
    """Masks [patterns, H, W] of squares, the same for every image of that size."""
    height, width = shape
    random = np.random.default_rng(0)
    holes = np.zeros((PATTERNS, *shape), bool)
    for hole in holes:
        for side in np.exp(random.uniform(np.log(SMALLEST), np.log(LARGEST), REGIONS)) * width:
            top, left = random.uniform(-side / 2, height - side / 2), random.uniform(-side / 2, width - side / 2)
            rows, columns = (slice(max(round(a), 0), max(round(a + side), 0)) for a in (top, left))
            hole[rows, columns] = True
    holes.setflags(write=False)
    return holes


def _relative(confidence: np.ndarray) -> np.ndarray:
    """Confidence [H, W] in units of its median: only how it is spread counts."""
    sure = confidence > 0
    return confidence / np.median(confidence[sure]) if sure.any() else confidence


def _shrunk(depth: np.ndarray) -> np.ndarray:
    """Every k-th pixel: depth is never averaged across an edge."""
    step = max(1, round(depth.shape[1] / WIDTH))
    return np.ascontiguousarray(depth[step // 2 :: step, step // 2 :: step], np.float32)


def _enlarged(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    cv2: Any = opencv("the uncertainty of monocular depth")
    return cv2.resize(values.astype(np.float32), shape[::-1], interpolation=cv2.INTER_NEAREST)

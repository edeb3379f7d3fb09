"""The lines of all frames of a block, fitted together (`align.together`), with what each frame alone would have given.

A block is what one process builds in order (`stereo.reuse_block`), so shards and single builds see the same frames. A
frame that is refused alone stays refused and tells the others nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.extras import opencv
from d2_plugin.priors.monocular.align import Alignment, align, predicted
from d2_plugin.priors.monocular.joint import Anchors, Tie, fit_joint
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.recordings.recording import MonoKind

ANCHORS, STATIC = 2000, 5000
"""Anchors per frame and static pixels per pair of frames that are used; all lie evenly over the image."""
GROUPS = 50
"""Static pixels are averaged in so many groups of like predictions: noise of the maps makes lines that must agree
flatter, and its mean does not."""

Changed = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(grey image, the one before) -> pixels whose neighbourhood changed, bool [H, W]."""


class Seen(NamedTuple):
    """One frame of one camera."""

    image: np.ndarray
    """RGB uint8 [H, W, 3]."""
    mono: np.ndarray
    """The prediction [H, W]; NaN where there is none."""
    geometric: np.ndarray
    """D^g [H, W], 0 where there is none."""


def aligned_together(
    frames: Mapping[int, Seen], kind: MonoKind, settings: AlignSettings, changed: Changed
) -> dict[int, Alignment]:
    """The alignment of each frame of one camera, by number, ascending.

    Where the joint fit is not certified, or a scale is not positive, each frame keeps the line that it has alone.
    """
    alone = {number: align(f.mono, f.geometric, kind=kind, settings=settings) for number, f in frames.items()}
    numbers = [number for number, found in alone.items() if found.accepted]
    if len(numbers) < 2:
        return alone
    known = [_anchors(frames[number], kind, settings) for number in numbers]
    unit = float(np.median(np.concatenate([anchors.y for anchors in known])))
    weight = 1 / unit if settings.residual == "relative" else 1.0
    pairs = pairwise(frames[number] for number in numbers)
    ties = [_tie(place, first, second, weight, changed) for place, (first, second) in enumerate(pairs)]
    epsilon = settings.epsilon if settings.residual == "relative" else settings.epsilon * unit
    fit = fit_joint(known, ties, epsilon=epsilon)
    if not (fit.gap <= settings.max_gap and (fit.scales > 0).all()):
        return alone
    lines = zip(numbers, fit.scales, fit.shifts, fit.scale_errors, strict=True)
    return alone | {
        number: replace(
            alone[number],
            scale=float(scale),
            shift=float(shift),
            gap=fit.gap,
            iterations=fit.iterations,
            objective=fit.objective,
            epsilon=epsilon,
            t=float(min(scale / max(error, np.finfo(float).tiny), 1e12)),
        )
        for number, scale, shift, error in lines
    }


def _anchors(frame: Seen, kind: MonoKind, settings: AlignSettings) -> Anchors:
    rows = _spread(predicted(frame.mono) & (frame.geometric > 0), ANCHORS)
    depth = frame.geometric.ravel()[rows].astype(np.float64)
    target = 1 / depth if kind == "relative" else depth
    weights = 1 / target if settings.residual == "relative" else np.ones_like(target)
    return Anchors(frame.mono.ravel()[rows].astype(np.float64), target, weights)


def _tie(place: int, first: Seen, second: Seen, weight: float, changed: Changed) -> Tie:
    """What two frames share: pixels around which the image did not change."""
    cv2 = opencv("aligning frames together")
    before, after = (cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY) for frame in (first, second))
    still = ~changed(after, before) & predicted(first.mono) & predicted(second.mono)
    rows = _spread(still, STATIC)
    x = np.stack([frame.mono.ravel()[rows].astype(np.float64) for frame in (first, second)])
    spreads = np.maximum(x.std(axis=1), np.finfo(float).tiny) if len(rows) else np.ones(2)
    groups = np.array_split(np.argsort((x / spreads[:, None]).sum(axis=0)), min(GROUPS, max(len(rows), 1)))
    means = np.stack([x[:, group].mean(axis=1) for group in groups], axis=1) if len(rows) else x
    return Tie(place, place + 1, means[0], means[1], weight)


def _spread(mask: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` pixels of a mask, evenly over it."""
    places = np.flatnonzero(mask)
    return places[np.linspace(0, max(len(places) - 1, 0), min(count, len(places))).astype(np.int64)]

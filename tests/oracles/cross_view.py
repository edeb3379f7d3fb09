"""`d2_plugin.priors.evidence` in NumPy: what the kernel of `cross_view` must return but for the last digits.

NumPy and the C library round logarithms and exponentials differently.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.cross_view import kernel
from d2_plugin.priors.cross_view.kernel import (
    BESIDE,
    COMPARED,
    DARK,
    FEWEST,
    FLATTEST,
    LIKE,
    LONGEST,
    MET,
    MISSED,
    NEAR,
    NUDGE,
    ONE_PLACE,
    OVERSHOT,
    STEPS,
    WITHIN,
)
from d2_plugin.priors.evidence import AGREED, ALONE, AT_BEST, view_of
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.priors.geometry import ViewPair, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera
from oracles.surface import interpolated_surface


def with_evidence(
    priors: Mapping[str, FusedPrior],
    cameras: Mapping[str, Camera],
    tolerance: float,
    tails: Mapping[str, float] | None = None,
) -> dict[str, FusedPrior]:
    """As `evidence.with_evidence`."""
    views = {name: View(**vars(view_of(prior))) for name, prior in priors.items()}
    known = {name: tail for name, tail in (tails or {}).items() if tail >= 1}
    return {
        name: _informed(name, prior, views, cameras, tolerance, AGREED / known.get(name, 1.0))
        for name, prior in priors.items()
    }


def _informed(
    name: str,
    prior: FusedPrior,
    views: Mapping[str, View],
    cameras: Mapping[str, Camera],
    tolerance: float,
    agreeing: float,
) -> FusedPrior:
    """The prior of one view with what the others say; `agreeing` is the factor of sigma where a map agrees."""
    rows, columns = np.nonzero(prior.labels == Label.MONO)
    depth, sigma = (map_[rows, columns].astype(np.float64) for map_ in (prior.depth, prior.sigma))
    colors = views[name].colors
    points = Points(columns, rows, depth, sigma, None if colors is None else colors[rows, columns])
    answer = ask(points, name, views, cameras, tolerance)
    met, agreed = answer.depth > 0, answer.agreed
    factor = np.where(agreed, agreeing, np.where(answer.seen, ALONE, 1.0))
    labels, depths, sigmas = prior.labels.copy(), prior.depth.copy(), prior.sigma.copy()
    labels[rows, columns] = np.where(met | agreed, Label.AGREED, Label.MONO)
    depths[rows, columns] = np.where(met, answer.depth, depth)
    sigmas[rows, columns] = np.where(met, answer.sigma, np.hypot(factor * sigma, np.where(agreed, AT_BEST, 0)))
    return replace(prior, depth=depths, labels=labels, sigma=sigmas)


class Points(NamedTuple):
    """K pixels of one view with the depth and sigma that are asked about."""

    columns: np.ndarray
    rows: np.ndarray
    depth: np.ndarray
    sigma: np.ndarray
    colors: np.ndarray | None
    """Mean of 3x3 pixels, uint8 [K, 3]; None where there is no image."""

    def only(self, chosen: np.ndarray) -> Points:
        return Points._make(None if values is None else values[chosen] for values in self)


class Answer(NamedTuple):
    """What the other cameras make of K points; all [K]."""

    depth: np.ndarray
    """Depth at which the ray meets a surface of another camera, float64; 0 where there is none."""
    sigma: np.ndarray
    """Of that depth, float64; infinite where there is none."""
    agreed: np.ndarray
    """Whether the monocular depth of another camera agrees, and the colours are alike, bool."""
    seen: np.ndarray
    """Whether another camera has a depth where the point lies in its image, bool."""


class View(kernel.View):
    """One view of an instant."""

    @functools.cached_property
    def surface(self) -> np.ndarray:
        """Depth that stereo verified, 0 elsewhere."""
        return np.where((self.labels == Label.VERIFIED) & (self.depth > 0), self.depth, np.float32(0))

    @functools.cached_property
    def compared(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of some verified pixels, evenly over the image."""
        known = np.flatnonzero(self.surface)
        rows, columns = np.divmod(known[:: max(len(known) // COMPARED, 1)], self.surface.shape[1])
        return rows, columns

    def apart(self, at: tuple[np.ndarray, np.ndarray], logs: np.ndarray, labels: tuple[Label, ...]) -> np.ndarray:
        """|log difference| [K] of points to the depths of pixels with one of the labels; infinite at others."""
        found = self.labels[at]
        labelled = functools.reduce(np.logical_or, [found == label for label in labels])
        return np.where(labelled, np.abs(logs - self.log[at]), np.inf)


def ask(
    points: Points, name: str, views: Mapping[str, View], cameras: Mapping[str, Camera], tolerance: float
) -> Answer:
    """What all others show of points of view `name`; `tolerance` is in log depth."""
    count = len(points.depth)
    depth, sigma = np.zeros(count), np.full(count, np.inf)
    agreed, seen = np.zeros(count, bool), np.zeros(count, bool)
    for other, theirs in views.items():
        if other == name or not count:
            continue
        pair = view_pair(cameras[name], cameras[other])
        gain = _gain(views[name], theirs, pair)
        asked = points if points.colors is None else points._replace(colors=points.colors * gain)
        place, at, logs = _inside(asked, pair, theirs.depth.shape)
        apart = theirs.apart(at, logs, (Label.MONO, Label.AGREED))
        seen[place] |= np.isfinite(apart)
        close = np.flatnonzero(apart < tolerance)
        agreed[place[close]] |= _alike(asked.only(place[close]), theirs, *(values[close] for values in at))
        near = place[theirs.apart(at, logs, (Label.VERIFIED,)) < MISSED]
        found, precision = _intersection(asked.only(near), pair, theirs)
        seen[near] |= found > 0
        better = precision < sigma[near]
        depth[near[better]], sigma[near[better]] = found[better], precision[better]
    return Answer(depth, sigma, agreed, seen)


def _inside(
    points: Points, pair: ViewPair, shape: tuple[int, ...]
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """(indices [I] of the points that fall into another view's image, nearest pixels there, log depth there)."""
    x, y, z = pair.project(points.columns, points.rows, points.depth)
    height, width = shape
    place = np.flatnonzero((z > 0) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5))
    row, column = (np.rint(values[place]).astype(np.int64) for values in (y, x))
    return place, (row, column), np.log(z[place])


def _intersection(points: Points, pair: ViewPair, theirs: View) -> tuple[np.ndarray, np.ndarray]:
    """Where the points' rays meet the surface that another view verified: (depth [K], 0 where nowhere; sigma [K])."""
    surface, near = theirs.surface, np.arange(len(points.depth))
    depth, sigma = np.zeros_like(points.depth), np.full_like(points.depth, np.inf)
    miss, known = _miss(points, pair, surface, points.depth)
    near, miss, points = near[known], miss[known], points.only(known)
    step = _step(points, pair, surface, points.depth, miss)
    kept = np.abs(step) < OVERSHOT * _allowed(points)
    near, step, points = near[kept], step[kept], points.only(kept)
    along = points.depth * np.exp(step)
    for _ in range(STEPS - 1):
        miss, known = _miss(points, pair, surface, along)
        along = along * np.exp(np.where(known, _step(points, pair, surface, along, miss), 0))
    miss, known = _miss(points, pair, surface, along)
    moved = np.abs(np.log(along / points.depth))
    met = known & (np.abs(miss) < MET) & (moved < _allowed(points))
    at = pair.project(points.columns, points.rows, along)
    height, width = surface.shape
    row = np.clip(np.rint(np.where(met, at.y, 0)), 0, height - 1).astype(np.int64)
    column = np.clip(np.rint(np.where(met, at.x, 0)), 0, width - 1).astype(np.int64)
    met &= _alike(points, theirs, row, column)
    depth[near] = np.where(met, along, 0)
    sigma[near] = np.where(met, np.hypot(theirs.sigma[row, column], BESIDE * moved), np.inf)
    return depth, sigma


def _alike(points: Points, theirs: View, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Whether the points [K] have the colour of another view's pixels; True where there is no image."""
    if points.colors is None or theirs.colors is None:
        return np.ones(len(points.depth), bool)
    apart = np.abs(points.colors.astype(np.float32) - theirs.colors[row, column])
    return (apart < LIKE * 255).all(axis=1)


def _gain(ours: View, theirs: View, pair: ViewPair) -> np.ndarray:
    """How much brighter the other camera shows what both verified, per channel [3]; 1 where that is too little."""
    rows, columns = ours.compared
    if ours.colors is None or theirs.colors is None or len(rows) < FEWEST:
        return np.ones(3, np.float32)
    depth, mine = ours.surface[rows, columns].astype(np.float64), ours.colors[rows, columns].astype(np.float32)
    place, at, logs = _inside(Points(columns, rows, depth, depth, mine), pair, theirs.surface.shape)
    seen = theirs.colors[at].astype(np.float32)
    one_place = theirs.apart(at, logs, (Label.VERIFIED,)) < ONE_PLACE
    bright = one_place & (np.minimum(mine[place], seen) > DARK).all(axis=1)
    if np.count_nonzero(bright) < FEWEST:
        return np.ones(3, np.float32)
    return np.median(seen[bright] / mine[place[bright]], axis=0)


def _allowed(points: Points) -> np.ndarray:
    """How far in log depth [K] a ray may be followed."""
    return np.minimum(WITHIN * points.sigma, NEAR)


def _step(points: Points, pair: ViewPair, surface: np.ndarray, depth: np.ndarray, miss: np.ndarray) -> np.ndarray:
    """Secant step in log depth [K] towards the surface, 0 where it is not known or runs along the ray."""
    ahead, known = _miss(points, pair, surface, depth * NUDGE)
    slope = (ahead - miss) / np.log(NUDGE)
    usable = known & (np.abs(slope) > FLATTEST)
    return np.clip(np.where(usable, -miss / np.where(usable, slope, 1), 0), -LONGEST, LONGEST)


def _miss(points: Points, pair: ViewPair, surface: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(log of the points' depth in the other view over the surface's there [K], where that is known [K])."""
    at = pair.project(points.columns, points.rows, depth)
    inside = at.z > 0
    known, there = interpolated_surface(surface, np.where(inside, at.x, -9), np.where(inside, at.y, -9))
    return np.log(np.where(known, at.z, 1) / np.where(known, there, 1)), known

"""`d2_plugin.priors.evidence` in NumPy: what the kernel of `cross_view` must return but for the last digits.

NumPy and the C library round logarithms and exponentials differently. All points of a view are asked everything, and
what does not hold is masked afterwards.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.cross_view import kernel
from d2_plugin.priors.cross_view.kernel import View
from d2_plugin.priors.evidence import AGREED, ALONE, AT_BEST, view_of
from d2_plugin.priors.geometry import ViewPair, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.maps import FusedPrior
from oracles.stereo_filter import interpolated_surface

Cameras = Mapping[str, Camera]


def with_evidence(
    priors: Mapping[str, FusedPrior], cameras: Cameras, tolerance: float, tails: Mapping[str, float] | None = None
) -> dict[str, FusedPrior]:
    """As `evidence.with_evidence`."""
    views = {name: view_of(prior) for name, prior in priors.items()}
    known = {name: tail for name, tail in (tails or {}).items() if tail >= 1}
    return {
        name: _informed(name, prior, views, cameras, tolerance, AGREED / known.get(name, 1.0))
        for name, prior in priors.items()
    }


class Points(NamedTuple):
    """K pixels of one view with the depth and sigma that are asked about."""

    columns: np.ndarray
    rows: np.ndarray
    depth: np.ndarray
    sigma: np.ndarray
    colors: np.ndarray | None
    """Mean of 3x3 pixels, [K, 3]; None where there is no image."""


def _informed(
    name: str, prior: FusedPrior, views: Mapping[str, View], cameras: Cameras, tolerance: float, agreeing: float
) -> FusedPrior:
    """The prior of one view with what the others say; `agreeing` is the factor of sigma where a map agrees."""
    rows, columns = np.nonzero(prior.labels == Label.MONO)
    depth, sigma = (map_[rows, columns].astype(np.float64) for map_ in (prior.depth, prior.sigma))
    colors = views[name].colors
    points = Points(columns, rows, depth, sigma, None if colors is None else colors[rows, columns])
    surface, surest = np.zeros(len(depth)), np.full(len(depth), np.inf)
    agreed, seen = np.zeros(len(depth), bool), np.zeros(len(depth), bool)
    for other, theirs in views.items():
        if other == name:
            continue
        pair = view_pair(cameras[name], cameras[other])
        gain = _gain(views[name], theirs, pair)
        asked = points if points.colors is None else points._replace(colors=points.colors * gain)
        at, apart = _apart(asked, pair, theirs, (Label.MONO, Label.AGREED))
        followed = _apart(asked, pair, theirs, (Label.VERIFIED,))[1] < kernel.MISSED
        found, precision = _intersection(asked, pair, theirs, followed)
        seen |= np.isfinite(apart) | (found > 0)
        agreed |= (apart < tolerance) & _alike(asked, theirs, *at)
        better = precision < surest
        surface, surest = np.where(better, found, surface), np.where(better, precision, surest)
    met = surface > 0
    factor = np.where(agreed, agreeing, np.where(seen, ALONE, 1.0))
    labels, depths, sigmas = prior.labels.copy(), prior.depth.copy(), prior.sigma.copy()
    labels[rows, columns] = np.where(met | agreed, Label.AGREED, Label.MONO)
    depths[rows, columns] = np.where(met, surface, depth)
    sigmas[rows, columns] = np.where(met, surest, np.hypot(factor * sigma, np.where(agreed, AT_BEST, 0)))
    return replace(prior, depth=depths, labels=labels, sigma=sigmas)


def _apart(
    points: Points, pair: ViewPair, theirs: View, labels: tuple[Label, ...]
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """(nearest pixels in another view, |log difference| [K] to their depths; infinite where labels are others)."""
    x, y, z = pair.project(points.columns, points.rows, points.depth)
    height, width = theirs.depth.shape
    inside = (z > 0) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    row, column = (np.rint(np.where(inside, values, 0)).astype(np.int64) for values in (y, x))
    compared = inside & np.isin(theirs.labels[row, column], labels)
    return (row, column), np.where(compared, np.abs(np.log(np.where(inside, z, 1)) - theirs.log[row, column]), np.inf)


def _surface(view: View) -> np.ndarray:
    """Depth that stereo verified, 0 elsewhere."""
    return np.where((view.labels == Label.VERIFIED) & (view.depth > 0), view.depth, np.float32(0))


def _intersection(points: Points, pair: ViewPair, theirs: View, followed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where followed rays meet the surface that another view verified: (depth [K], 0 where nowhere; sigma [K])."""
    surface, allowed = _surface(theirs), np.minimum(kernel.WITHIN * points.sigma, kernel.NEAR)
    miss, known = _miss(points, pair, surface, points.depth)
    step = _step(points, pair, surface, points.depth, miss)
    followed = followed & known & (np.abs(step) < kernel.OVERSHOT * allowed)
    along = points.depth * np.exp(step)
    for _ in range(kernel.STEPS - 1):
        miss, known = _miss(points, pair, surface, along)
        along = along * np.exp(np.where(known, _step(points, pair, surface, along, miss), 0))
    miss, known = _miss(points, pair, surface, along)
    moved = np.abs(np.log(along / points.depth))
    met = followed & known & (np.abs(miss) < kernel.MET) & (moved < allowed)
    at = pair.project(points.columns, points.rows, along)
    row, column = (np.rint(np.where(met, values, 0)).astype(np.int64) for values in (at.y, at.x))
    met &= _alike(points, theirs, row, column)
    return np.where(met, along, 0), np.where(met, np.hypot(theirs.sigma[row, column], kernel.BESIDE * moved), np.inf)


def _alike(points: Points, theirs: View, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Whether the points [K] have the colour of another view's pixels; True where there is no image."""
    if points.colors is None or theirs.colors is None:
        return np.ones(len(points.depth), bool)
    apart = np.abs(points.colors.astype(np.float32) - theirs.colors[row, column])
    return (apart < kernel.LIKE * 255).all(axis=1)


def _gain(ours: View, theirs: View, pair: ViewPair) -> np.ndarray:
    """How much brighter the other camera shows what both verified, per channel [3]; 1 where that is too little."""
    surface = _surface(ours)
    known = np.flatnonzero(surface)
    if ours.colors is None or theirs.colors is None or len(known) < kernel.FEWEST:
        return np.ones(3, np.float32)
    rows, columns = np.divmod(known[:: max(len(known) // kernel.COMPARED, 1)], surface.shape[1])
    depth, mine = surface[rows, columns].astype(np.float64), ours.colors[rows, columns].astype(np.float32)
    at, apart = _apart(Points(columns, rows, depth, depth, mine), pair, theirs, (Label.VERIFIED,))
    seen = theirs.colors[at].astype(np.float32)
    bright = (apart < kernel.ONE_PLACE) & (np.minimum(mine, seen) > kernel.DARK).all(axis=1)
    if np.count_nonzero(bright) < kernel.FEWEST:
        return np.ones(3, np.float32)
    return np.median(seen[bright] / mine[bright], axis=0)


def _step(points: Points, pair: ViewPair, surface: np.ndarray, depth: np.ndarray, miss: np.ndarray) -> np.ndarray:
    """Secant step in log depth [K] towards the surface, 0 where it is not known or runs along the ray."""
    ahead, known = _miss(points, pair, surface, depth * kernel.NUDGE)
    slope = (ahead - miss) / np.log(kernel.NUDGE)
    usable = known & (np.abs(slope) > kernel.FLATTEST)
    return np.clip(np.where(usable, -miss / np.where(usable, slope, 1), 0), -kernel.LONGEST, kernel.LONGEST)


def _miss(points: Points, pair: ViewPair, surface: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(log of the points' depth in the other view over the surface's there [K], where that is known [K])."""
    at = pair.project(points.columns, points.rows, depth)
    inside = at.z > 0
    known, there = interpolated_surface(surface, np.where(inside, at.x, -9), np.where(inside, at.y, -9))
    return np.log(np.where(known, at.z, 1) / np.where(known, there, 1)), known

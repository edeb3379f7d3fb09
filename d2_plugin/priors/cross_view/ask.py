"""One view's points as the others see them: do their maps agree, and where do the points' rays meet their surfaces?

What `kernel.ask` answers, where there is no compiler; the numbers and the types are those of both.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.geometry import ViewPair, interpolated_surface, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera

WITHIN = 1.2
"""A surface confirms a monocular depth within this many of its standard deviations. Farther ones are often another
surface: on studio the 90 % quantile of the error is .011 within, .17 beyond."""
NEAR = 0.1
"""And within this relative difference, whatever is declared."""
BESIDE = 0.03
"""Share of the step to the surface that may remain as error."""
LIKE = 0.04
"""Largest difference of the colours (0..1, mean of 3x3 pixels) of one place in two images. A ray that passes a near
thing which the map does not know meets the surface behind it. Measured on the surfaces that rays meet, those off by
more than 5 %: studio 1.3 % and .4 % with this test, with a weak network (PyDNet) 48 and 13 %; plaza with it 1.5 and
.1 %. It keeps 88 to 96 % of the right ones."""
DARK = 20
"""Of 255: a darker pixel does not tell how differently two cameras are exposed."""
FEWEST = 100
"""Nor do fewer pixels than this that both verified."""
ONE_PLACE = 0.02
"""Nor does a pixel whose depth in the other view is off by more, in log depth."""
COMPARED = 8000
"""About how many verified pixels are compared for it, evenly over the image."""
STEPS = 3
"""Secant steps along the ray."""
NUDGE = 1.001
"""Factor of depth between the two points of a secant."""
FLATTEST = 0.2
"""Where the miss changes by less per log depth, the surface runs along the ray."""
LONGEST = 0.2
"""Longest step, in log depth."""
MET = 3e-3
"""The ray has met the surface when their depths differ by less than this share."""
MISSED = 0.5
"""A ray that misses by more, in log depth, is not followed."""
OVERSHOT = 2.0
"""Nor one whose first step is so many times farther than allowed."""


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


@dataclass(frozen=True, eq=False)
class View:
    """What one view tells the others; contiguous maps [H, W]."""

    labels: np.ndarray
    """`Label`, uint8."""
    depth: np.ndarray
    """float32."""
    log: np.ndarray
    """Logarithm of the depth, float32; infinite where there is none."""
    sigma: np.ndarray
    """float32."""
    colors: np.ndarray | None
    """Mean of 3x3 pixels, uint8 [H, W, 3]; None where there is no image."""

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
    """What all others say about points of view `name`.

    Args:
        points: of that view.
        name: of that view.
        views: all of one instant, by camera.
        cameras: their calibrations.
        tolerance: largest difference in log depth at which two monocular depths agree.
    """
    count = len(points.depth)
    depth, sigma = np.zeros(count), np.full(count, np.inf)
    agreed, seen = np.zeros(count, bool), np.zeros(count, bool)
    for other, theirs in views.items():
        if other == name or not count:
            continue
        pair = view_pair(cameras[name], cameras[other])
        asked = _as_seen_by(points, _gain(views[name], theirs, pair))
        place, at, logs = _inside(asked, pair, theirs.depth.shape)
        apart = theirs.apart(at, logs, (Label.MONO, Label.AGREED))
        seen[place] |= np.isfinite(apart)
        close = np.flatnonzero(apart < tolerance)
        agreed[place[close]] |= _alike(asked.only(place[close]), theirs, *(values[close] for values in at))
        # Most rays start where nothing is verified; those whose first step leaves the allowed way several times over
        # meet nothing either. Only the others are followed.
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
    return _in_all_channels(apart < LIKE * 255)


def _in_all_channels(holds: np.ndarray) -> np.ndarray:
    """Whether something holds [K, 3] in all three, [K]; NumPy's own reduction takes ten times as long."""
    return holds[:, 0] & holds[:, 1] & holds[:, 2]


def _as_seen_by(points: Points, gain: np.ndarray) -> Points:
    """The points in the colours of a camera that shows everything so many times brighter."""
    return points if points.colors is None else points._replace(colors=points.colors * gain)


def _gain(ours: View, theirs: View, pair: ViewPair) -> np.ndarray:
    """How much brighter the other camera shows what both verified, per channel [3]; 1 where that is too little."""
    rows, columns = ours.compared
    if ours.colors is None or theirs.colors is None or len(rows) < FEWEST:
        return np.ones(3, np.float32)
    depth, mine = ours.surface[rows, columns].astype(np.float64), ours.colors[rows, columns].astype(np.float32)
    place, at, logs = _inside(Points(columns, rows, depth, depth, mine), pair, theirs.surface.shape)
    seen = theirs.colors[at].astype(np.float32)
    one_place = theirs.apart(at, logs, (Label.VERIFIED,)) < ONE_PLACE
    bright = one_place & _in_all_channels(np.minimum(mine[place], seen) > DARK)
    if np.count_nonzero(bright) < FEWEST:
        return np.ones(3, np.float32)
    return np.median((seen[bright] / mine[place[bright]]).T.copy(), axis=1)


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

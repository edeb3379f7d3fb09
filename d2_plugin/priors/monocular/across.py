"""Slopes of maps whose anchors leave them open, from what two cameras' maps must share; an addition to the paper.

Where cameras stand far apart stereo may know one tree and nothing else. Such anchors fix the depth at one value of the
map and leave the slope of its line open: drawn on to the rest of the image it may be wrong by any factor. But the
ground and the walls that two maps show are one surface, and with the wrong slopes they part. So the slopes are those
with which most pixels of one map, seen by the other camera, lie where its map has them:

    maximise over the slopes   sum of exp(-r^2 / 2 s^2),   r = log(depth of the pixel there / the other map's),

over even samples of every two maps, both ways. Each line passes through the medians of its anchors, so there is one
unknown a map. The sum has other maxima, so slopes are tried on a grid, two maps at a time where none is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.evidence import AT_BEST
from d2_plugin.priors.geometry import view_pair
from d2_plugin.priors.monocular.align import INLIER_ERROR, SEED, Alignment, AlignStatus, predicted
from d2_plugin.recordings.recording import Camera, MonoKind

SPAN = 0.15
"""Anchors whose values span a smaller share of the map's leave its slope open."""
RANGE, MOST = (0.02, 0.98), (0.1, 0.9)
"""Quantiles between which a map's values span, and those of anchors: a handful on a passer-by leave a slope open."""
SLOPES = np.geomspace(0.03, 3, 28)
"""What is tried, in units of the slope with which the smallest values of the map lie infinitely far (of an inverse
map), or that of a line through the origin (of a depth map)."""
FINER = 9
"""Slopes tried between a slope and its neighbours, each time the last step is refined."""
LEANING = 0.03
"""Share of the objective that a slope e times the unit or a e-th of it costs: cameras of one height see the same of a
floor with every slope, and a map is nearer to what it says of itself than to nothing at all."""
LEAST_REACH = 0.05
"""Anchors nearer than this to the smallest values of an inverse map, as a share of its span, count as so far off."""
SAMPLES = 5000
"""Pixels of each map that are compared."""
SPREAD = 0.07
"""s: how far two maps that belong to their images differ, in log depth."""
MATCHED = 0.35
"""Mean of exp(-r^2 / 2 s^2) over the pixels that another camera sees, below which the maps show no common surface."""
SEEN = 0.05
"""Share of the samples that another camera must see."""

OPEN = (AlignStatus.OK, AlignStatus.ONE_DEPTH, AlignStatus.UNSTABLE, AlignStatus.BOUNDARY, AlignStatus.FLAT)
"""What a fit to anchors of too small a span may end with."""


class Shown(NamedTuple):
    """One view of an instant."""

    camera: Camera
    mono: np.ndarray
    """The prediction [H, W]; NaN where there is none."""
    geometric: np.ndarray
    """D^g [H, W], 0 where there is none."""
    alignment: Alignment
    """What these two alone give."""


def aligned_across(views: Mapping[str, Shown], kind: MonoKind) -> dict[str, Alignment]:
    """The alignments of the views whose anchors leave the slope open, by name; without those whose slope stays unknown.

    Where there are such views, the others come too, with their own lines and how far their maps part from these.

    Args:
        views: synchronized views. Those with well spread anchors keep their lines and help the others.
    """
    wanted = [name for name, view in views.items() if is_open(view)]
    if not wanted:
        return {}
    maps = {
        name: _Map.of(view, kind, name in wanted)
        for name, view in views.items()
        if name in wanted or view.alignment.accepted
    }
    while wanted and len(maps) > 1:
        lines = _fitted(maps, wanted)
        fits = {name: _agreement(name, maps, lines) for name in maps}
        worst = min(wanted, key=lambda name: fits[name].matched)
        if fits[worst].matched >= MATCHED:
            spreads = {name: max(fit.spread, AT_BEST) for name, fit in fits.items() if fit.matched >= MATCHED}
            alignments = {name: replace(views[name].alignment, across=spread) for name, spread in spreads.items()}
            shared = {name: _through(alignments[name], views[name], lines[name], kind) for name in wanted}
            return alignments | shared
        wanted.remove(worst)
        del maps[worst]
    return {}


def is_open(view: Shown) -> bool:
    """Whether a view's anchors fix one depth of its map and leave the slope open."""
    if view.alignment.status not in OPEN:
        return False
    known = predicted(view.mono)
    anchors = view.mono[known & (view.geometric > 0)]
    if not anchors.size or (view.alignment.kind == "metric" and not np.median(anchors) > 0):
        return False  # the slopes of a depth map are tried in units of the line from the origin to its anchors
    first, last = (float(np.quantile(anchors, share)) for share in MOST)
    if last - first > SPAN * (np.fmax.reduce(view.mono, axis=None) - np.fmin.reduce(view.mono, axis=None)):
        return False  # nearly always, and spares the quantiles of the whole map
    low, high = np.quantile(view.mono[known], RANGE)
    return bool(last - first < SPAN * (high - low))


def shared_scale(maps: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], tried: np.ndarray) -> Shared:
    """The one factor of all depth maps with which they fit each other best where they overlap.

    What counts is the mean over what other cameras see. The sum would prefer small factors, with which more is seen: a
    ground below cameras of one height is the same plane with any factor.

    Args:
        maps: planar depth [H, W] by camera, up to the factor; NaN or 0 where there is none.
        tried: factors, ascending; more are tried between the best and its neighbours.
    """
    nothing = Alignment(AlignStatus.NOT_ALIGNED, "metric")
    shown = {
        name: _Map.of(Shown(cameras[name], depth, np.zeros_like(depth), nothing), "metric")
        for name, depth in maps.items()
        if predicted(depth).any()
    }

    def matched(factor: float) -> float:
        line = _Line(factor, 0.0)
        apart = [_apart(one, two, line, [line])[0] for one, two in permutations(shown.values(), 2)]
        enough = sum(part.size for part in apart) >= SEEN * SAMPLES
        return float(_match(np.concatenate(apart)).mean()) if enough else 0.0

    factor = 1.0
    for _ in range(min(2, len(tried)) if len(shown) > 1 else 0):
        best = int(np.argmax([matched(factor) for factor in tried]))
        around = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
        factor, tried = float(tried[best]), np.geomspace(*around, 2 * FINER + 1)
    lines = dict.fromkeys(shown, _Line(factor, 0.0))
    return Shared(factor, {name: _agreement(name, shown, lines) for name in shown} if len(shown) > 1 else {})


class Agreement(NamedTuple):
    """How well a map fits the others where they overlap."""

    matched: float
    """Mean of exp(-r^2 / 2 s^2); 0 where they see too little of each other."""
    spread: float
    """Standard deviation of either map: the median of |r|, to which both add, over that of a normal error."""


class Shared(NamedTuple):
    """One scale of several maps."""

    scale: float
    agreements: dict[str, Agreement]
    """How well each map then fits the others."""


class _Line(NamedTuple):
    """What a map's values are turned into: inverse depth, or depth."""

    scale: float
    shift: float


@dataclass(frozen=True, eq=False)
class _Map:
    """A map, samples of it, and the lines that are tried."""

    camera: Camera
    values: np.ndarray
    """The prediction [H, W]."""
    inverse: bool
    """Whether lines give inverse depth."""
    place: tuple[np.ndarray, np.ndarray]
    """Columns and rows [n] of the samples."""
    pivot: tuple[float, float]
    """Medians of the anchors: value, and what it is turned into."""
    unit: float
    """Slope whose multiples are tried; 0 where the line is known."""
    known: _Line

    @classmethod
    def of(cls, view: Shown, kind: MonoKind, unknown: bool = False) -> _Map:
        known, inverse = predicted(view.mono), kind == "relative"
        anchors = known & (view.geometric > 0)
        target = view.geometric[anchors].astype(np.float64)
        x, y = (float(np.median(v)) if v.size else 0.0 for v in (view.mono[anchors], 1 / target if inverse else target))
        rows, columns = np.nonzero(known)
        chosen = np.random.default_rng(SEED).integers(0, len(rows), SAMPLES)
        reach = x
        if inverse:
            low, high = np.quantile(view.mono[known], RANGE)
            reach = max(x - low, LEAST_REACH * (high - low))
        unit = y / reach if unknown and reach > 0 else 0.0
        line = _Line(view.alignment.scale, view.alignment.shift)
        return cls(view.camera, view.mono, inverse, (columns[chosen], rows[chosen]), (x, y), unit, line)

    def line(self, slope: float) -> _Line:
        """Through the pivot, `slope` in units."""
        scale = slope * self.unit
        return _Line(scale, self.pivot[1] - scale * self.pivot[0])

    def depth(self, values: np.ndarray, lines: Sequence[_Line]) -> np.ndarray:
        """Depths [lines, values]; NaN where a line has none."""
        scales, shifts = (np.array(part)[:, None] for part in zip(*lines, strict=True))
        turned = scales * values + shifts
        safe = np.where(turned > 0, turned, np.nan)
        return 1 / safe if self.inverse else safe


def _fitted(maps: Mapping[str, _Map], wanted: Sequence[str]) -> dict[str, _Line]:
    """The lines of all maps: those of `wanted` one after another, the surest first, then each once more and finer."""
    lines = {name: map_.known for name, map_ in maps.items() if name not in wanted}
    slopes: dict[str, float] = {}
    if not lines:
        slopes = _first_two(maps, wanted)
        lines = {name: maps[name].line(slope) for name, slope in slopes.items()}
    while len(slopes) < len(wanted):
        scores = {name: _scores(name, SLOPES, maps, lines) for name in wanted if name not in slopes}
        name = max(scores, key=lambda name: scores[name].max())
        slopes[name] = float(SLOPES[(scores[name] * _leaning(SLOPES)).argmax()])
        lines[name] = maps[name].line(slopes[name])
    step = SLOPES[1] / SLOPES[0]
    for reach in (step, step, step ** (2 / FINER)):
        for name in wanted:
            tried = slopes[name] * np.geomspace(1 / reach, reach, FINER)
            slopes[name] = float(tried[(_scores(name, tried, maps, lines) * _leaning(tried)).argmax()])
            lines[name] = maps[name].line(slopes[name])
    return lines


def _first_two(maps: Mapping[str, _Map], wanted: Sequence[str]) -> dict[str, float]:
    """The slopes of the two maps that fit each other best."""
    best, slopes = -1.0, {}
    for one, other in combinations(wanted, 2):
        tried = [[maps[name].line(slope) for slope in SLOPES] for name in (one, other)]
        scores = _matches(maps[one], maps[other], *tried) + _matches(maps[other], maps[one], *tried[::-1]).T
        scores *= np.outer(_leaning(SLOPES), _leaning(SLOPES))
        if scores.max() > best:
            first, second = np.unravel_index(scores.argmax(), scores.shape)
            best, slopes = float(scores.max()), {one: float(SLOPES[first]), other: float(SLOPES[second])}
    return slopes


def _leaning(slopes: np.ndarray) -> np.ndarray:
    """What is left of the objective at slopes [n], in units, for how far they are from 1."""
    return 1 - LEANING * np.abs(np.log(slopes))


def _scores(name: str, slopes: np.ndarray, maps: Mapping[str, _Map], lines: Mapping[str, _Line]) -> np.ndarray:
    """The part of the objective that one map's slope decides, for each of `slopes`, all other lines given."""
    ours, tried = maps[name], [maps[name].line(slope) for slope in slopes]
    total = np.zeros(len(slopes))
    for other, line in lines.items():
        if other != name:
            total += _matches(ours, maps[other], tried, [line])[:, 0] + _matches(maps[other], ours, [line], tried)[0]
    return total


def _agreement(name: str, maps: Mapping[str, _Map], lines: Mapping[str, _Line]) -> Agreement:
    apart = np.concatenate(
        [
            _apart(maps[one], maps[two], lines[one], [lines[two]])[0]
            for other in lines
            if other != name
            for one, two in ((name, other), (other, name))
        ]
    )
    if len(apart) < SEEN * SAMPLES:
        return Agreement(0.0, np.inf)
    spread = float(np.median(np.nan_to_num(np.abs(apart), nan=np.inf))) / NormalDist().inv_cdf(0.75) / np.sqrt(2)
    return Agreement(float(_match(apart).mean()), spread)


def _matches(ours: _Map, theirs: _Map, our_lines: Sequence[_Line], their_lines: Sequence[_Line]) -> np.ndarray:
    """Sum of matches of our samples with the other map, [our lines, their lines]."""
    return np.stack([_match(_apart(ours, theirs, line, their_lines)).sum(axis=1) for line in our_lines])


def _match(apart: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.exp(-0.5 * (apart / SPREAD) ** 2))


def _apart(ours: _Map, theirs: _Map, line: _Line, their_lines: Sequence[_Line]) -> np.ndarray:
    """r [their lines, n] of our samples that the other camera sees and its map knows; NaN where that is no depth."""
    columns, rows = ours.place
    pair, (height, width) = view_pair(ours.camera, theirs.camera), theirs.values.shape
    depth = ours.depth(ours.values[rows, columns].astype(np.float64), [line])[0]
    at = pair.project(columns, rows, np.nan_to_num(depth, nan=-1.0))
    inside = (depth > 0) & (at.z > 0) & (at.x > -0.5) & (at.x < width - 0.5) & (at.y > -0.5) & (at.y < height - 0.5)
    there = theirs.values[np.rint(at.y[inside]).astype(np.int64), np.rint(at.x[inside]).astype(np.int64)]
    known = predicted(there)
    return np.log(at.z[inside][known] / theirs.depth(there[known].astype(np.float64), their_lines))


def _through(alignment: Alignment, view: Shown, line: _Line, kind: MonoKind) -> Alignment:
    anchors = predicted(view.mono) & (view.geometric > 0)
    turned = line.scale * view.mono[anchors].astype(np.float64) + line.shift
    depth = 1 / np.where(turned > 0, turned, np.nan) if kind == "relative" else turned
    return replace(
        alignment,
        status=AlignStatus.ACROSS,
        scale=line.scale,
        shift=line.shift,
        inliers=float(np.mean(np.abs(depth / view.geometric[anchors] - 1) < INLIER_ERROR)),
    )

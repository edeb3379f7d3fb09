"""When cameras started, from what they saw move: change over time, plane by plane through the cameras' baseline.

A point that moves lies, in both images of a pair of cameras, in the same half-plane through the line that joins them,
however far away it is. So the change of brightness from one frame to the next is added up per half-plane: two profiles
over angle and time, which are alike once they are laid over each other at the right lag. Their correlation over the
lag, summed over all pairs, has its peak where the clocks agree, and between frames too, since the profiles are
interpolated. Gains, turns and frame rates of the cameras do not matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.importing.profiles import FINE, GROUPS, Curve, Watched, changes_of, curve_between

LONG_SIDE = 160
"""Pixels of the images that are compared."""

MOST_FRAMES = 900
"""Of each camera; they take 13 MB."""

FEWEST = 8
"""Frames that a camera must share with one of the others."""

ALIKE = 0.2
"""Mean correlation that the pairs of a camera must reach."""

RIVAL = 0.8
"""Another lag that is this good, outside of the peak, makes a camera's offset doubtful."""

FINEST = 0.05
"""Frames: no offset from motion is said to be surer."""


class Seen(NamedTuple):
    """What motion says about one camera."""

    seconds: float
    """When its clock began, after that of the first camera."""
    error: float
    """Standard error, seconds."""
    alike: float
    """Mean correlation with the other cameras at that offset."""
    doubt: str
    """Why it cannot be trusted; empty where it can."""


def offsets_from_motion(watched: Mapping[str, Watched], search: float) -> dict[str, Seen]:
    """When each camera's clock began, after that of the first one.

    Args:
        watched: at least two calibrated cameras.
        search: largest difference that is looked for, seconds.
    """
    names = list(watched)
    frame = float(np.median(np.concatenate([np.diff(one.times) for one in watched.values()])))
    step = frame / FINE
    changes = {name: changes_of(one) for name, one in watched.items()}
    curves = {}
    for one, other in combinations(names, 2):
        pair = curve_between(watched[one], watched[other], changes[one], changes[other], step, search)
        if pair is not None:
            curves[one, other] = pair
    offsets = _agreed(names, curves, None)
    without = np.array([list(_agreed(names, curves, group, offsets).values()) for group in range(GROUPS)])
    spread = np.sqrt((GROUPS - 1) / GROUPS * ((without - without.mean(0)) ** 2).sum(0)) * step
    found = {}
    for place, name in enumerate(names):
        alike, doubt = _trust(name, offsets, curves)
        found[name] = Seen(offsets[name] * step, float(max(spread[place], FINEST * frame)), alike, doubt)
    return found


def _agreed(
    names: Sequence[str],
    curves: Mapping[tuple[str, str], Curve],
    without: int | None,
    start: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Offsets, in steps, at which the sum of the scores of all pairs has its peak."""
    scores = {pair: (curve.lags, curve.score(without)) for pair, curve in curves.items()}
    offsets = dict(start) if start is not None else _tree(names, scores)
    for _ in range(20):
        before = dict(offsets)
        for name in names[1:]:
            lags, total = _alone(name, offsets, scores)
            if len(lags):
                offsets[name] = _summit(lags, total, near=None if start is None else offsets[name])
        if all(abs(offsets[name] - before[name]) < 0.01 for name in names):
            break
    return offsets


def _tree(names: Sequence[str], scores: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """A start: from the first camera on, each is hung to the one that it agrees with best."""
    offsets = {names[0]: 0.0}
    while len(offsets) < len(names):
        best = None
        for (one, other), (lags, score) in scores.items():
            if (one in offsets) != (other in offsets) and len(lags) and (best is None or score.max() > best[0]):
                lag = float(lags[score.argmax()])
                new = (other, offsets[one] + lag) if one in offsets else (one, offsets[other] - lag)
                best = (score.max(), *new)
        if best is None:
            return offsets | {name: 0.0 for name in names if name not in offsets}
        offsets[best[1]] = best[2]
    return offsets


def _alone(
    name: str, offsets: Mapping[str, float], scores: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """(offsets of one camera, sum of its scores there) with the other cameras where they are."""
    curves = []
    for (one, other), (lags, score) in scores.items():
        if name == other:
            curves.append((lags + offsets[one], score))
        elif name == one:
            curves.append((offsets[other] - lags[::-1], score[::-1]))
    if not curves:
        return np.zeros(0), np.zeros(0)
    places = np.arange(min(lags[0] for lags, _ in curves), max(lags[-1] for lags, _ in curves) + 0.5)
    return places, np.sum([np.interp(places, lags, score, left=0, right=0) for lags, score in curves], axis=0)


def _summit(places: np.ndarray, total: np.ndarray, near: float | None) -> float:
    """The place of the peak, of that within a frame of `near` where given, by a parabola over half a frame."""
    allowed = np.ones(len(places), bool) if near is None else np.abs(places - near) <= FINE
    top = int(np.where(allowed, total, -np.inf).argmax())
    low, high = max(top - FINE // 2, 0), min(top + FINE // 2, len(places) - 1)
    if high - low < 2:
        return float(places[top])
    bend, slope, _ = np.polyfit(places[low : high + 1] - places[top], total[low : high + 1], 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(places[top] + np.clip(shift, -FINE / 2, FINE / 2))


def _trust(name: str, offsets: Mapping[str, float], curves: Mapping[tuple[str, str], Curve]) -> tuple[float, str]:
    """(mean correlation with the others, why the offset is doubtful)."""
    correlations = [
        float(np.interp(offsets[other] - offsets[one], curve.lags, np.nan_to_num(curve.correlation())))
        for (one, other), curve in curves.items()
        if name in (one, other)
    ]
    scores = {pair: (curve.lags, curve.score()) for pair, curve in curves.items()}
    places, total = _alone(name, offsets, scores)
    if not correlations or not len(places):
        return 0.0, "it shares no view with another camera"
    shared = max(
        float(np.interp(offsets[other] - offsets[one], curve.lags, curve.common))
        for (one, other), curve in curves.items()
        if name in (one, other)
    )
    alike = float(np.mean(correlations))
    if shared < FEWEST:
        return alike, f"it shares {shared:.0f} frames with the others, fewer than {FEWEST}"
    if alike < ALIKE:
        return alike, f"what moves in it does not move in the others (correlation {alike:.2f})"
    top = int(np.abs(places - offsets[name]).argmin())
    rival = _rival(total, top)
    if rival is not None and total[rival] > RIVAL * total[top]:
        frames = (places[rival] - places[top]) / FINE
        return alike, f"an offset that differs by {frames:+.1f} frames is as good (is the motion repeated?)"
    return alike, ""


def _rival(total: np.ndarray, top: int) -> int | None:
    """The best place outside of the peak at `top`: beyond where the curve has fallen to half and rises again."""
    outside = np.ones(len(total), bool)
    for way in (-1, 1):
        place, lowest = top, total[top]
        while 0 <= place < len(total) and not (total[place] > lowest and lowest < 0.7 * total[top]):
            lowest = min(lowest, total[place])
            outside[place] = False
            place += way
    return int(np.where(outside, total, -np.inf).argmax()) if outside.any() else None

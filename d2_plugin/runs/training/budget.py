"""How many steps a method trains in a given CPU time: tried out, since schedules must know their length beforehand."""

from __future__ import annotations

import math
from collections.abc import Sequence

PILOT = 100
"""Steps of the first try."""
TOLERANCE = 0.1
"""A run whose time is this near to the budget is the run of that budget."""
TRIES = 4
"""After so many the nearest counts; its own time stands beside its score."""
GROWTH = 1.1
"""Time ~ steps^GROWTH where only one length was tried: Gaussians become more."""

Timed = tuple[int, float]
"""Steps of a run, and the CPU seconds that it trained."""


def next_steps(target: float, tried: Sequence[Timed]) -> int:
    """Steps to try for `target` seconds, from what was tried before: a power law through the two nearest."""
    if not tried:
        return PILOT
    lengths: dict[int, list[float]] = {}
    for steps, seconds in tried:
        lengths.setdefault(steps, []).append(max(seconds, 1e-3))
    means = [(steps, sum(seconds_of) / len(seconds_of)) for steps, seconds_of in lengths.items()]
    (steps, seconds), *others = sorted(means, key=lambda timed: abs(math.log(timed[1] / target)))
    power = _power((steps, seconds), others[0]) if others else GROWTH
    return max(round(steps * (target / seconds) ** (1 / power)), 1)


def _power(first: Timed, second: Timed) -> float:
    """Slope of log time over log steps, kept where the noise of short runs cannot lead astray."""
    slope = math.log(second[1] / first[1]) / math.log(second[0] / first[0])
    return min(max(slope, 0.8), 2.0)


def fits(target: float, timed: Timed) -> bool:
    """Whether a run took that long."""
    return abs(timed[1] / target - 1) <= TOLERANCE


def nearest(target: float, tried: Sequence[Timed]) -> int:
    """Steps of the run whose time is nearest to the budget, in ratio."""
    return min(tried, key=lambda timed: abs(math.log(max(timed[1], 1e-3) / target)))[0]

"""Error against run time: means over cases, the Pareto front, the plot and the table under it.

After the work-precision diagrams of SciML and the fronts of ann-benchmarks: one series per method, one mark per
setting, both axes logarithmic, lower left is better. What another setting beats in both is faded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from d2_plugin.runs.report.svg import Axis, Plot, Point, Series, number
from d2_plugin.runs.rows import Row

SMALLEST = 1e-16
"""Errors below this are drawn here: they are rounding, and a logarithm needs a floor."""


@dataclass(frozen=True)
class Mean:
    """One setting of one method over all its cases: geometric means where it worked, and where it did not."""

    method: str
    setting: str
    error: float | None
    worst: float | None
    seconds: float | None
    cases: int
    failures: int


class Drawn(NamedTuple):
    """A mean whose error and time are both known."""

    mean: Mean
    seconds: float
    error: float


def means(rows: Sequence[Row]) -> list[Mean]:
    """One `Mean` per (method, setting), in order of appearance."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["setting"]), []).append(row)
    return [_mean(*key, group) for key, group in groups.items()]


def _mean(method: str, setting: str, group: Sequence[Row]) -> Mean:
    errors = [row["error"] for row in group if row["error"] is not None]
    seconds = [row["seconds"] for row in group if row["seconds"]]
    failures = sum(bool(row["failed"]) for row in group)
    worst = max(errors, default=None)
    return Mean(method, setting, _geometric(errors), worst, _geometric(seconds), len(group), failures)


def _geometric(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return math.exp(sum(math.log(max(value, SMALLEST)) for value in values) / len(values))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other one beats in both coordinates (lower is better), in order of the first."""
    front, best = [], math.inf
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if points[index][1] < best:
            best = points[index][1]
            front.append(index)
    return front


def colors_of(rows: Sequence[Row]) -> dict[str, int]:
    """A colour for each method, the same in all plots of a section."""
    return {name: color for color, name in enumerate(dict.fromkeys(row["method"] for row in rows))}


def work_precision(
    rows: Sequence[Row],
    title: str,
    error_label: str,
    seconds_label: str,
    unit: float = 1,
    colors: Mapping[str, int] | None = None,
) -> Plot:
    """The plot of all settings; `unit` is what seconds are multiplied by to match `seconds_label`.

    A setting that failed on some case is faded and never on the front: a mean over the easy cases is no result.
    """
    marks = [Drawn(m, m.seconds, m.error) for m in means(rows) if m.error is not None and m.seconds]
    front = {mark.mean for mark in _front(marks)}
    series = []
    for name, color in (colors or colors_of(rows)).items():
        mine = [mark for mark in marks if mark.mean.method == name]
        points = tuple(_point(mark, unit, mark.mean in front, error_label, seconds_label) for mark in mine)
        line = tuple((mark.seconds * unit, max(mark.error, SMALLEST)) for mark in _front(mine))
        series.append(Series(name, points, line, color))
    x = Axis.around(seconds_label, [mark.seconds * unit for mark in marks], log=True)
    y = Axis.around(error_label, [max(mark.error, SMALLEST) for mark in marks], log=True)
    return Plot(title, x, y, tuple(series))


def _front(marks: Sequence[Drawn]) -> list[Drawn]:
    """What nothing beats in both among the settings that worked on every case, by time."""
    whole = [mark for mark in marks if not mark.mean.failures]
    return [whole[i] for i in pareto_front([(mark.seconds, mark.error) for mark in whole])]


def _point(mark: Drawn, unit: float, on_front: bool, error_label: str, seconds_label: str) -> Point:
    mean = mark.mean
    measured = f"{error_label} {shown(mark.error)}, {seconds_label} {shown(mark.seconds * unit)}"
    note = f"{mean.method}, {mean.setting}: {measured}"
    note += f"; failed on {mean.failures} of {mean.cases}" if mean.failures else ""
    return Point(mark.seconds * unit, max(mark.error, SMALLEST), note, faded=not on_front)


def shown(value: float | None) -> str:
    """Three digits, or `-` where it was not measured."""
    return "-" if value is None else number(float(f"{value:.3g}"))

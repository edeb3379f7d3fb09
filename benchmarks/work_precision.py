"""Error against run time: means over cases, the Pareto front, and the plot.

After the work-precision diagrams of SciML and the fronts of ann-benchmarks: one series per method, one mark per
setting, both axes logarithmic, lower left is better. What another setting beats in both is faded.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from benchmarks.rows import grouped
from d2_plugin.runs.report.svg import Axis, Plot, Point, Series, number
from d2_plugin.runs.rows import Row

SMALLEST = 1e-16
"""Errors below this are drawn here: they are rounding, and a logarithm needs a floor."""


class Mean(NamedTuple):
    """One setting of one method over all its cases: geometric means where it worked, NaN where it never did."""

    method: str
    setting: str
    error: float
    seconds: float
    cases: int
    failures: int


def means(rows: Sequence[Row]) -> list[Mean]:
    """One `Mean` per (method, setting), in order of appearance."""
    return [
        Mean(
            *(key[0], key[1]),
            _geometric(row["error"] for row in group if row["error"] is not None),
            _geometric(row["seconds"] for row in group if row["seconds"]),
            len(group),
            sum(bool(row["failed"]) for row in group),
        )
        for key, group in grouped(rows, "method", "setting").items()
    ]


def _geometric(values: Iterable[float]) -> float:
    logarithms = [math.log(max(value, SMALLEST)) for value in values]
    return math.exp(sum(logarithms) / len(logarithms)) if logarithms else math.nan


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
    marks = [mean for mean in means(rows) if not math.isnan(mean.error + mean.seconds)]
    front = _front(marks)

    def point(mean: Mean) -> Point:
        measured = f"{error_label} {shown(mean.error)}, {seconds_label} {shown(mean.seconds * unit)}"
        failed = f"; failed on {mean.failures} of {mean.cases}" if mean.failures else ""
        note = f"{mean.method}, {mean.setting}: {measured}{failed}"
        return Point(mean.seconds * unit, mean.error, note, faded=mean not in front)

    series = []
    for name, color in (colors or colors_of(rows)).items():
        mine = [mark for mark in marks if mark.method == name]
        line = tuple((mark.seconds * unit, mark.error) for mark in _front(mine))
        series.append(Series(name, tuple(map(point, mine)), line, color))
    x = Axis.around(seconds_label, [mark.seconds * unit for mark in marks], log=True)
    y = Axis.around(error_label, [mark.error for mark in marks], log=True)
    return Plot(title, x, y, tuple(series))


def _front(marks: Sequence[Mean]) -> list[Mean]:
    """What nothing beats in both among the settings that worked on every case, by time."""
    whole = [mark for mark in marks if not mark.failures]
    return [whole[i] for i in pareto_front([(mark.seconds, mark.error) for mark in whole])]


def shown(value: float | None) -> str:
    """Three digits, or `-` where it was not measured."""
    return "-" if value is None else number(float(f"{value:.3g}"))

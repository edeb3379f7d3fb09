"""The part of the report about the depth prior: how large it says that its errors are, and how large they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from d2_plugin.priors.declared_error import DECLARED, label_name
from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series
from d2_plugin.runs.report.sections import Section, cases_of, sources_of
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.rows import Row

LABELS = tuple(map(label_name, DECLARED))
"""Labels whose sigma is drawn; each has its colour in all plots."""
DIAGONAL = "declared = true"
DIAGONAL_COLOR = 5
GOAL, GOAL_TWO = (0.6, 0.8), 0.9
"""Share of the errors within sigma, from and to, and least share within 2 sigma."""
COUNTED = 0.01
"""The goal is set for labels that this share of the pixels carry; the others are faded."""
FAINT = 0.05
"""A mark that holds a smaller share of its label's pixels is faded."""


def priors(rows: Sequence[Row]) -> Section:
    """Declared against true error: one diagram per recording, one line per label, on the same axes."""
    latest = _latest(rows)
    curves = [row for row in latest if row.get("curve")]
    ends = _ends(value for row in curves for point in row["curve"] for value in point[:2])
    plots = [_diagram(case, mine, ends) for case, mine in cases_of(curves).items()]
    emulated = any(row.get("mono_emulated") for row in latest)
    tables = [("Errors within the declared sigma", _calibration_table(latest)), ("Far pixels", _far_table(latest))]
    return Section(
        "priors",
        "Priors: declared against true error",
        "Sigma is the relative standard deviation that the prior declares for the depth of a pixel. A mark holds the "
        "pixels of one label whose sigma is alike; 68 % of their true errors |log(D / true)| are smaller than its "
        f"height. It is faded where it holds less than {_whole(FAINT)} of that label's pixels. On the dashed diagonal "
        "the prior is as wrong as it says; above, it is overconfident, and below, too cautious. Goal, for every label "
        f"that {_whole(COUNTED)} of the pixels carry: {_goal()}; what meets it stands out in the table. A pixel "
        "without a true depth is sky, or nobody measured it."
        + (" Monocular depth of some recordings is emulated, not predicted." if emulated else ""),
        {"priors": figure(plots, "Reliability: true error against declared sigma", columns=3, size=(340, 330))},
        tuple((title, table) for title, table in tables if table.rows),
        sources=sources_of(latest),
        headlines=tuple(filter(None, [_headline(latest)])),
    )


def _latest(rows: Sequence[Row]) -> list[Row]:
    """The last measurement of each recording."""
    last = {row["case"]: (row["commit"], row["command"]) for row in rows}
    mine = [row for row in rows if (row["commit"], row["command"]) == last[row["case"]]]
    return list({(row["case"], row["method"]): row for row in mine}.values())


def _ends(values: Iterable[float]) -> tuple[float, float]:
    """One range for both axes of all plots, so that the diagonal is one and recordings compare."""
    axis = Axis.around("", values, log=True)
    return axis.low, axis.high


def _diagram(case: str, rows: Sequence[Row], ends: tuple[float, float]) -> Plot:
    series = [Series(DIAGONAL, (), ((ends[0], ends[0]), (ends[1], ends[1])), DIAGONAL_COLOR, hollow=True)]
    for color, label in enumerate(LABELS):
        for row in rows:
            if row["method"] == label:
                line = tuple((sigma, error) for sigma, error, _ in row["curve"])
                series.append(Series(label, _points(row), line, color))
    x, y = (Axis(label, *ends, log=True) for label in ("declared sigma", "true error, 68 % quantile"))
    return Plot(case, x, y, tuple(series))


def _points(row: Row) -> tuple[Point, ...]:
    least = FAINT * sum(pixels for *_, pixels in row["curve"])
    return tuple(
        Point(
            *(sigma, error),
            f"{row['method']}, {row['case']}: sigma {sigma:.2%}, error {error:.2%}, {pixels} pixels",
            faded=row["share"] < COUNTED or pixels < least,
        )
        for sigma, error, pixels in row["curve"]
    )


def _calibration_table(rows: Sequence[Row]) -> Table:
    header = ("recording", "label", "share of pixels", "within sigma", "within 2 sigma", "median sigma", "median error")
    shares = ("share", "within", "within_two", "median_sigma", "median_error")
    held = [row for row in rows if row.get("within") is not None]
    cells = tuple(
        (row["case"], row["method"], *(_percent(row, name) for name in shares), _seconds(row)) for row in held
    )
    met = {(place, 3) for place, row in enumerate(held) if _in_goal(row)}
    met |= {(place, 4) for place, row in enumerate(held) if row["within_two"] >= GOAL_TWO}
    return Table((*header, "s per image"), cells, frozenset(met))


def _in_goal(row: Row) -> bool:
    return GOAL[0] <= row["within"] <= GOAL[1]


def _far_table(rows: Sequence[Row]) -> Table:
    """How much of what has no depth is found to be far, and how much else is taken for it."""
    header = ("recording", "far, of pixels without true depth", "far, of the others")
    found = [row for row in rows if row.get("false_far") is not None]
    return Table(header, tuple((row["case"], _percent(row, "sky_found"), _percent(row, "false_far")) for row in found))


def _headline(rows: Sequence[Row]) -> str:
    """How many labels meet the goal, and which do not."""
    counted = [row for row in rows if row.get("within") is not None and row["share"] >= COUNTED]
    missed = [row for row in counted if not (_in_goal(row) and row["within_two"] >= GOAL_TWO)]
    if not counted:
        return ""
    others = [f"{case} ({', '.join(row['method'] for row in mine)})" for case, mine in cases_of(missed).items()]
    met = f"{_goal()} for {len(counted) - len(missed)} of {len(counted)} labels"
    return f"{met}; not for {'; '.join(others)}" if others else met


def _whole(share: float) -> str:
    return f"{100 * share:.0f} %"


def _goal() -> str:
    low, high = GOAL
    return f"{100 * low:.0f} to {_whole(high)} of the errors within sigma, at least {_whole(GOAL_TWO)} within 2 sigma"


def _percent(row: Mapping[str, float | None], name: str) -> str:
    """Two digits behind the point where it is small; a dash where it was not measured."""
    value = row.get(name)
    if value is None:
        return "-"
    return f"{value:.2%}" if "median" in name or value < COUNTED else f"{value:.1%}"


def _seconds(row: Row) -> str:
    return "-" if row["seconds"] is None else f"{row['seconds']:.2f}"

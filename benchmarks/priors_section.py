"""The part of the report about the depth prior: how large it says that its errors are, and how large they are."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from d2_plugin.priors.declared_error import DECLARED, label_name
from d2_plugin.runs.report.page import Section, sources_of
from d2_plugin.runs.report.svg import Axis, Plot, Point, Series, figure
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import Table

LABELS = tuple(map(label_name, DECLARED))
"""Labels whose sigma is drawn; each has its colour in all plots."""
DIAGONAL = "declared = true"
DIAGONAL_COLOR = 5


def priors(rows: Sequence[Row]) -> Section:
    """Declared against true error: one diagram per recording, one line per label, on the same axes."""
    curves = [row for row in rows if row.get("curve")]
    axis = Axis.around("", (value for row in curves for point in row["curve"] for value in point[:2]), log=True)
    cases = dict.fromkeys(row["case"] for row in curves)
    plots = [_diagram(case, [row for row in curves if row["case"] == case], axis) for case in cases]
    emulated = any(row.get("mono_emulated") for row in rows)
    tables = [
        ("Errors within the declared sigma", _calibration_table(rows)),
        ("Far pixels", _far_table(rows)),
        ("What moves: scene flow, and what lies between two instants", _motion_table(rows)),
    ]
    return Section(
        "priors",
        "Priors: declared against true error",
        "Sigma is the relative standard deviation that the prior declares for the depth of a pixel. A mark holds the "
        "pixels of one label whose sigma is alike; 68 % of their true errors |log(D / true)| are smaller than its "
        "height. On the dashed diagonal the prior is as wrong as it says; above, it is overconfident, and below, too "
        "cautious. A normal error lies within sigma at 68 % and within 2 sigma at 95 % of the pixels. A pixel without "
        "a true depth is sky, or nobody measured it."
        + (" Monocular depth of some recordings is emulated, not predicted." if emulated else ""),
        {"priors": figure(plots, "Reliability: true error against declared sigma", columns=3, size=(340, 330))},
        tuple((title, table) for title, table in tables if table.rows),
        sources=sources_of(rows),
    )


def _diagram(case: str, rows: Sequence[Row], axis: Axis) -> Plot:
    """One range for both axes of all plots, so that the diagonal is one and recordings compare."""
    diagonal = tuple((end, end) for end in (axis.low, axis.high))
    series = [Series(DIAGONAL, (), diagonal, DIAGONAL_COLOR, hollow=True)]
    for color, label in enumerate(LABELS):
        for row in rows:
            if row["method"] == label:
                line = tuple((sigma, error) for sigma, error, _ in row["curve"])
                series.append(Series(label, _points(row), line, color))
    x, y = (replace(axis, label=label) for label in ("declared sigma", "true error, 68 % quantile"))
    return Plot(case, x, y, tuple(series))


def _points(row: Row) -> tuple[Point, ...]:
    note = f"{row['method']}, {row['case']}"
    return tuple(
        Point(sigma, error, f"{note}: sigma {sigma:.2%}, error {error:.2%}, {pixels} pixels")
        for sigma, error, pixels in row["curve"]
    )


def _calibration_table(rows: Sequence[Row]) -> Table:
    header = ("recording", "label", "share of pixels", "within sigma", "within 2 sigma", "median sigma", "median error")
    shares = ("share", "within", "within_two", "median_sigma", "median_error")
    held = [row for row in rows if row.get("within") is not None]
    cells = tuple(
        (row["case"], row["method"], *(_percent(row, name) for name in shares), f"{row['seconds']:.2f}") for row in held
    )
    return Table((*header, "s per image"), cells)


def _far_table(rows: Sequence[Row]) -> Table:
    """How much of what has no depth is found to be far, and how much else is taken for it."""
    header = ("recording", "far, of pixels without true depth", "far, of the others")
    found = [row for row in rows if row.get("false_far") is not None]
    return Table(header, tuple((row["case"], _percent(row, "sky_found"), _percent(row, "false_far")) for row in found))


def _motion_table(rows: Sequence[Row]) -> Table:
    """Flow, and colours and depth at three quarters between instants, at pixels that move."""
    header = ("recording", "flow right within 1 px", "median error px", "known between", "PSNR of it", "with depth")
    shares = ("motion_with_depth", "motion_within", "motion_within_two", "motion_sigma", "motion_error")
    cells = tuple(
        (
            row["case"],
            _percent(row, "motion_right"),
            f"{row['motion_flow_error']:.2f}",
            _percent(row, "motion_known"),
            f"{row['motion_psnr']:.2f}",
            *(_percent(row, name) for name in shares),
        )
        for row in rows
        if row.get("motion_right") is not None
    )
    return Table((*header, "within sigma", "within 2 sigma", "median sigma", "median error"), cells)


def _percent(row: Mapping[str, float | None], name: str) -> str:
    """Two digits behind the point where it is small; a dash where it was not measured."""
    value = row.get(name)
    if value is None:
        return "-"
    return f"{value:.2%}" if "median" in name or value < 0.01 else f"{value:.1%}"

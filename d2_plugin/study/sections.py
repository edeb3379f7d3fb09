"""The parts of the report, one per kind of row: what is shown, in which plots and tables, and where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from .bench_raster import exponent
from .provenance import provenance
from .rows import Row
from .svg import Axis, Plot, Point, Series, figure, number
from .work_precision import SMALLEST, Table, colors_of, means_table, shown, work_precision


@dataclass(frozen=True)
class Section:
    """One part of the report; `figures` are SVG by name, `tables` come with a title."""

    name: str
    title: str
    text: str
    figures: dict[str, str] = field(default_factory=dict)
    tables: tuple[tuple[str, Table], ...] = ()
    details: tuple[tuple[str, Table], ...] = ()
    """Longer tables, which the page folds and the Markdown leaves out."""
    sources: tuple[str, ...] = ()


def sources_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """One sentence per machine, commit and command that the rows come from."""
    return tuple(dict.fromkeys(provenance(row) for row in rows))


def cases_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows by case, in order of appearance."""
    return {case: [row for row in rows if row["case"] == case] for case in dict.fromkeys(row["case"] for row in rows)}


def alignment(rows: Sequence[Row]) -> Section:
    """The Charbonnier fit: objective gap against milliseconds, one plot per share of outliers."""
    error, time = "F / F* - 1", "milliseconds per map"
    cases, colors = cases_of(rows), colors_of(rows)
    plots = [work_precision(mine, case, error, time, 1e3, colors) for case, mine in cases.items()]
    return Section(
        "alignment",
        "Alignment: the positive-scale Charbonnier fit",
        "How far the objective is above the least value that any solver reached, in float64. Differences below "
        f"{number(SMALLEST)} are drawn there. Only d2 certifies its gap; the others do not know when they are done.",
        {"alignment": figure(plots, "Objective gap against run time of the alignment", columns=3, size=(340, 320))},
        (("Error and milliseconds", _beside(cases, error)),),
        sources=sources_of(rows),
    )


def _beside(cases: Mapping[str, Sequence[Row]], error: str) -> Table:
    """One row per setting, for each case its error and milliseconds; what is on the case's front stands out."""
    tables = [means_table(mine, error, "ms", 1e3) for mine in cases.values()]
    header = ("method", "setting", *(title for case in cases for title in (f"{case}: {error}", "ms")))
    lines = [
        (*alike[0][:2], *(cell for line in alike for cell in (line[2], line[4])))
        for alike in zip(*(table.rows for table in tables))
    ]
    best = {(row, 2 * i + 2 + (column == 4)) for i, table in enumerate(tables) for row, column in table.best}
    return Table(header, tuple(lines), frozenset(best))


def stereo(rows: Sequence[Row]) -> Section:
    """Geometric depth after the common filter: 1 - F against CPU seconds per view, mean over rigs."""
    error, time = "1 - F at 1 %", "CPU seconds per view"
    header = ("rig", "method", "setting", "completeness", "F at 1 %", "median error", "off > 5 %", "CPU s")
    cells = tuple(
        (row["case"], row["method"], row["setting"], *(shown(row.get(name)) for name in _STEREO)) for row in rows
    )
    return Section(
        "stereo",
        "Stereo: geometric depth",
        "F is the harmonic mean of the share of depths within 1 % of the truth and the share of co-visible pixels "
        "that have such a depth, after the same filter for every method; geometric means over the rigs. A setting "
        "that failed on a rig is faded.",
        {"stereo": figure([work_precision(rows, "Mean over rigs", error, time)], "1 - F against CPU time of stereo")},
        (("Mean over rigs", means_table(rows, error, "CPU s")),),
        (("Every rig", Table(header, cells)),),
        sources_of(rows),
    )


_STEREO = ("completeness", "f1", "median", "wrong", "cpu")


def raster(rows: Sequence[Row]) -> Section:
    """The rasterizer: deviation from float64 against milliseconds, one mark per scene and size."""
    error, time = "colour error against float64, p99.9", "forward + backward, ms"
    drawn = [row for row in rows if row["error"] and row["seconds"]]
    series = [
        Series(name, tuple(_raster_point(row) for row in drawn if row["method"] == name), color=color)
        for name, color in colors_of(drawn).items()
    ]
    x = Axis.around(time, [point.x for each in series for point in each.points], log=True)
    y = Axis.around(error, [point.y for each in series for point in each.points], log=True)
    header = ("method", "scene", "forward ms", "forward + backward ms", "survey ms", "peak MB", "colour p99.9")
    header += ("worst gradient",)
    return Section(
        "raster",
        "Rasterizer: time and precision",
        "Median wall time. The error is the 99.9th percentile of the colour's deviation (0..1) from the same image in "
        "float64; the worst gradient is the largest relative L2 deviation of any input's gradient, without the pixels "
        "where rounding decided a threshold differently.",
        {"raster": figure([Plot("Every scene and size", x, y, tuple(series))], "Rasterizer error against time")},
        (("Every scene and size", Table(header, tuple(_raster_cells(row) for row in rows))),),
        sources=sources_of(rows),
    )


def _raster_point(row: Row) -> Point:
    milliseconds = 1e3 * row["seconds"]
    note = f"{row['method']}, {row['case']}: error {shown(row['error'])} in {milliseconds:.3g} ms"
    return Point(milliseconds, row["error"], note, row["case"])


def _raster_cells(row: Row) -> tuple[str, ...]:
    errors = row.get("errors") or {}
    gradients = [part["relative_l2"] for name, part in errors.items() if name.startswith("grad")]
    times = [row["passes"].get(name) for name in ("forward", "forward+backward", "survey")]
    milliseconds = [f"{found['median_ms']:.2f} ± {found['iqr_ms'] / 2:.2f}" if found else "-" for found in times]
    return (
        *(row["method"], row["case"], *milliseconds, shown(row.get("peak_mb"))),
        *(shown(row["error"]), shown(max(gradients, default=None))),
    )


def stability(rows: Sequence[Row]) -> Section:
    """Sweeps to where numbers end: one plot per sweep, float32 beside float64."""
    plots = [_sweep(case, mine) for case, mine in cases_of(rows).items()]
    header = ("sweep", "precision", "range", "points", "ok", "gap", "failure", "largest error", "limit")
    cells = tuple(
        _sweep_cells(case, method, [row for row in mine if row["method"] == method])
        for case, mine in cases_of(rows).items()
        for method in dict.fromkeys(row["method"] for row in mine)
    )
    meanings = tuple((case, mine[0]["measures"], mine[0]["guard"]) for case, mine in cases_of(rows).items())
    guards = Table(("sweep", "the error is", "what is guarded, and how"), meanings)
    lost = [row for row in rows if row["verdict"] != "ok"]
    return Section(
        "stability",
        "Stability: stiff and extreme cases",
        "Each parameter is swept to where other codebases break. ok: the error is below the sweep's limit; gap: it is "
        "above, and finite; failure: not finite, or refused where it should not be. Nothing is clamped in silence: "
        "the second table says what is guarded.",
        {"stability": figure(plots, "Error over each swept parameter", columns=3, size=(360, 270))},
        (("Sweeps", Table(header, cells)), ("Guards", guards), *([("Not ok", _lost(lost))] if lost else [])),
        sources=sources_of(rows),
    )


def _lost(rows: Sequence[Row]) -> Table:
    header = ("sweep", "precision", "value", "verdict", "error", "limit", "why")
    cells = (
        (
            *(row["case"], row["method"], number(row["value"]), row["verdict"]),
            *(shown(row["error"]), shown(row["limit"]), row["failed"] or row["guard"]),
        )
        for row in rows
    )
    return Table(header, tuple(cells))


def _sweep(case: str, rows: Sequence[Row]) -> Plot:
    log = all(row["value"] > 0 for row in rows) and max(r["value"] for r in rows) > 50 * min(r["value"] for r in rows)
    series = []
    for method, color in colors_of(rows).items():
        mine = [row for row in rows if row["method"] == method and row["error"] is not None]
        places = [(row["value"], max(row["error"], SMALLEST)) for row in mine]
        points = tuple(
            Point(x, y, f"{method}, {number(x)}: {shown(row['error'])}, {row['verdict']}")
            for (x, y), row in zip(places, mine)
        )
        series.append(Series(method, points, tuple(places), color))
        limit = next(row["limit"] for row in rows if row["method"] == method)
        ends = (min(row["value"] for row in rows), max(row["value"] for row in rows))
        series.append(Series(f"limit of {method}", (), tuple((end, limit) for end in ends), color, hollow=True))
    x = Axis.around(rows[0]["parameter"], [row["value"] for row in rows], log)
    y = Axis.around("error", [y for each in series for _, y in each.line], log=True)
    return Plot(case, x, y, tuple(series))


def _sweep_cells(case: str, method: str, rows: Sequence[Row]) -> tuple[str, ...]:
    values = [row["value"] for row in rows]
    count = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in ("ok", "gap", "failure")}
    span = f"{rows[0]['parameter']}: {number(min(values))} .. {number(max(values))}"
    worst = max((row["error"] for row in rows if row["error"] is not None), default=None)
    return (case, method, span, str(len(rows)), *map(str, count.values()), shown(worst), shown(rows[0]["limit"]))


def plan(rows: Sequence[Row]) -> Section:
    """What is left out: its saving and its cost on the capture, measured with and without."""
    header = ("capture", "decision", "by the plan", "run", "s", "peak MB", "Gaussians", "cost", "in")
    cells = tuple(
        (
            *(row["case"], row["method"], row["planned"], row["setting"], shown(row["seconds"])),
            *(shown(row.get("peak_mb")), str(row.get("gaussians") or "-")),
            *(row["failed"] or shown(row.get("cost")), row.get("unit", "-")),
        )
        for row in rows
    )
    return Section(
        "plan",
        "What a scene does not need",
        "Each decision of the plan, taken both ways on the capture itself: time, memory and Gaussians with and "
        "without, and what leaving it out costs (negative: it gains).",
        tables=(("Decisions", Table(header, cells)),),
        sources=sources_of(rows),
    )


def scaling(rows: Sequence[Row]) -> Section:
    """How time and memory grow with the number of frames."""
    measured = {"seconds": "seconds", "peak_mb": "peak MB"}
    plots, cells = [], []
    for name, label in measured.items():
        series = []
        for method, color in colors_of(rows).items():
            mine = [row for row in rows if row["method"] == method and row.get(name)]
            places = tuple((row["frames"], row[name]) for row in mine)
            power = exponent(places) if len(mine) > 1 else None
            points = tuple(Point(*place, f"{method}: {number(place[1])} {label}") for place in places)
            series.append(Series(method, points, places, color))
            if places:
                grows = "-" if power is None else f"frames^{power:.2f}"
                cells.append((method, label, *(f"{frames}: {number(round(v, 2))}" for frames, v in places), grows))
        values = [point.y for each in series for point in each.points]
        x = Axis.around("frames", [row["frames"] for row in rows], log=True)
        plots.append(Plot(label, x, Axis.around(label, values, log=True), tuple(series)))
    width = max(len(line) for line in cells)
    cells = [(*line[:-1], *["-"] * (width - len(line)), line[-1]) for line in cells]
    header = ("part", "of", *(f"frames, {i + 1}" for i in range(width - 3)), "grows as")
    return Section(
        "scaling",
        "Growth with the number of frames",
        "Priors may grow linearly; the memory of training stays flat, since frames are read when they are needed.",
        {"scaling": figure(plots, "Time and memory over the number of frames", columns=2, size=(400, 320))},
        (("Measured", Table(header, tuple(cells))),),
        sources=sources_of(rows),
    )


SECTIONS: dict[str, Callable[[Sequence[Row]], Section]] = {
    "alignment": alignment,
    "stereo": stereo,
    "raster": raster,
    "stability": stability,
    "plan": plan,
    "scaling": scaling,
}

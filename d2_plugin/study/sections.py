"""The parts of the report, one per kind of row: what is shown, in which plots and tables, and where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf

from .bench_raster import exponent
from .provenance import provenance
from .rows import Row
from .svg import Axis, Plot, Point, Series, figure, number
from .work_precision import SMALLEST, Table, colors_of, means, means_table, shown, work_precision


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
    return tuple(dict.fromkeys(_source(row) for row in rows))


def _source(row: Row) -> str:
    if row["device"] is None:
        return f"`{row['command']}`, which recorded neither machine nor commit."
    return provenance(row)


def cases_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows by case, in order of appearance."""
    return {case: [row for row in rows if row["case"] == case] for case in dict.fromkeys(row["case"] for row in rows)}


ALIGNED_ANCHORS = 20_000
"""Number of anchors that is plotted, or the nearest one that was measured."""


def alignment(rows: Sequence[Row]) -> Section:
    """The fit: objective gap and error of aligned depth against milliseconds, one plot per share of wrong anchors."""
    anchors = min({row["anchors"] for row in rows}, key=lambda count: abs(count - ALIGNED_ANCHORS))
    chosen = [row for row in rows if row["anchors"] == anchors]
    shares = {share: [row for row in chosen if row["outliers"] == share] for share in _distinct(chosen, "outliers")}
    colors, time = colors_of(rows), "ms per fit"
    worse = {share: [{**row, "error": row["depth_error"]} for row in mine] for share, mine in shares.items()}
    plots = [
        work_precision(mine, f"{share:.0%} wrong", label, time, 1e3, colors)
        for label, of in (("F / F* - 1", shares), ("depth error", worse))
        for share, mine in of.items()
    ]
    return Section(
        "alignment",
        "Alignment: the positive-scale Charbonnier fit",
        f"Fits of {anchors} anchors, geometric means over the kinds of map. Above: how far the objective is above its "
        f"optimum (less than {number(SMALLEST)} is drawn there); only the certified solver knows its own gap. "
        "Below: median relative error of aligned depth that is due to the line.",
        {"alignment": figure(plots, "Gap and depth error of alignment", columns=len(shares), size=(276, 270))},
        ((f"Depth error by share of wrong anchors, {anchors} anchors", _alignment_table(shares)),),
        sources=sources_of(rows),
    )


def _alignment_table(shares: Mapping[float, Sequence[Row]]) -> Table:
    """Per setting: depth error at each share, worst gap, milliseconds, refusals; the least depth errors stand out."""
    every = [row for mine in shares.values() for row in mine]
    header = ("method", "setting", *(f"{share:.0%} wrong" for share in shares), "worst gap", "ms", "refused")
    lines: list[tuple[str, ...]] = []
    errors: list[list[float]] = []
    for mean in means(every):
        of = lambda mine, m=mean: [r for r in mine if (r["method"], r["setting"]) == (m.method, m.setting)]  # noqa: E731
        found = [[row["depth_error"] for row in of(mine) if not row["failed"]] for mine in shares.values()]
        errors.append([max(each, default=inf) for each in found])
        cells = (shown(value if value < inf else None) for value in errors[-1])
        seconds = mean.seconds and mean.seconds * 1e3
        lines.append((mean.method, mean.setting, *cells, shown(mean.worst), shown(seconds), str(mean.failures or "-")))
    columns = range(len(shares))
    best = {(min(range(len(lines)), key=lambda i: errors[i][column]), column + 2) for column in columns}
    return Table(header, tuple(lines), frozenset(best))


def _distinct(rows: Sequence[Row], name: str) -> list[float]:
    return sorted({row[name] for row in rows})


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
    swept = [row for row in rows if "thresholds" in row]
    plain = [row for row in rows if "thresholds" not in row]
    drawn = [row for row in plain if row["error"] and row["seconds"]]
    series = [
        Series(name, tuple(_raster_point(row) for row in drawn if row["method"] == name), color=color)
        for name, color in colors_of(drawn).items()
    ]
    x = Axis.around(time, [point.x for each in series for point in each.points], log=True)
    y = Axis.around(error, [point.y for each in series for point in each.points], log=True)
    thresholds = [work_precision(m, case, "colour error, p99.9", time, 1e3) for case, m in cases_of(swept).items()]
    header = ("method", "scene", "forward ms", "forward + backward ms", "survey ms", "peak MB", "colour p99.9")
    header += ("worst gradient",)
    return Section(
        "raster",
        "Rasterizer: time and precision",
        "Median wall time. The error is the 99.9th percentile of the colour's deviation (0..1) from the same image in "
        "float64; the worst gradient is the largest relative L2 deviation of any input's gradient, without the pixels "
        "where rounding decided a threshold differently. The thresholds (contributions below alpha are left out, a "
        "pixel is finished at a transmittance T) are compared with an image that has next to none.",
        {
            "raster": figure([Plot("Every scene and size", x, y, tuple(series))], "Rasterizer error against time"),
            "raster-thresholds": figure(thresholds, "Cost of the thresholds of splatting", columns=2, size=(480, 320)),
        },
        (("Every scene and size", Table(header, tuple(_raster_cells(row) for row in plain))),),
        (("Thresholds, mean over scenes and sizes", means_table(swept, "colour p99.9", "ms", 1e3)),),
        sources_of(rows),
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
    header = ("capture", "decision", "by the plan", "s", "peak MB", "Gaussians", "cost of leaving it out")
    decisions = dict.fromkeys((row["case"], row["method"]) for row in rows)
    cells = tuple(_decision([row for row in rows if (row["case"], row["method"]) == key]) for key in decisions)
    return Section(
        "plan",
        "Scene plan: what is left out",
        "Each decision of the plan, taken both ways on the capture itself: time, memory and Gaussians with the part → "
        "without it, and what leaving it out costs (negative: it gains).",
        tables=(("Decisions", Table(header, cells)),),
        sources=sources_of(rows),
    )


def _decision(rows: Sequence[Row]) -> tuple[str, ...]:
    """One line of the table: with the part, an arrow, and without it."""
    names = ("seconds", "peak_mb", "gaussians")
    both = ("-" if rows[0].get(n) is None else " → ".join(_rounded(row[n]) for row in rows) for n in names)
    first, last = rows[0], rows[-1]
    cost = first["failed"] or ("-" if last["cost"] is None else f"{last['cost']:+.3f} {last['unit']}")
    return (first["case"], first["method"], first["planned"], *both, cost)


def _rounded(value: float) -> str:
    """A count as it is, anything else in three digits."""
    return str(value) if isinstance(value, int) else shown(value)


def scaling(rows: Sequence[Row]) -> Section:
    """How time and memory grow with the number of frames."""
    lengths, colors = _distinct(rows, "frames"), colors_of(rows)
    x = Axis.around("frames", lengths, log=True)
    plots, cells = [], []
    for name, label in (("seconds", "seconds"), ("peak_mb", "peak MB")):
        series = []
        for method, color in colors.items():
            places = {row["frames"]: row[name] for row in rows if row["method"] == method and row.get(name)}
            line = tuple(places.items())
            points = tuple(Point(*place, f"{method}, {place[0]} frames: {place[1]:.4g} {label}") for place in line)
            series.append(Series(method, points, line, color))
            power = exponent(line) if len(line) > 1 else None
            grows = "-" if power is None else f"frames^{power:.2f}"
            cells.append((method, label, *(shown(places.get(length)) for length in lengths), grows))
        values = [y for each in series for _, y in each.line]
        plots.append(Plot(label, x, Axis.around(label, values, log=True), tuple(series)))
    header = ("part", "of", *(f"{length:g} frames" for length in lengths), "grows as")
    return Section(
        "scaling",
        "Scaling: growth with the number of frames",
        "Priors should take no more than linearly longer, and training no more memory: frames are read when needed.",
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

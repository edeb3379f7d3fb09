"""The parts of the report about error against run time: alignment, stereo, rasterizer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series, number
from d2_plugin.runs.report.sections import Section, cases_of, distinct, sources_of
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.report.work_precision import SMALLEST, Mean, colors_of, means, means_table, shown, work_precision
from d2_plugin.runs.rows import Row

ALIGNED_ANCHORS = 20_000
"""Number of anchors that is plotted, or the nearest one that was measured."""


def alignment(rows: Sequence[Row]) -> Section:
    """The fit: objective gap and error of aligned depth against milliseconds, one plot per share of wrong anchors."""
    anchors = min({row["anchors"] for row in rows}, key=lambda count: abs(count - ALIGNED_ANCHORS))
    chosen = [row for row in rows if row["anchors"] == anchors]
    shares = {share: [row for row in chosen if row["outliers"] == share] for share in distinct(chosen, "outliers")}
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
    found = means(every)
    errors = [[_worst_depth_error(mine, mean) for mine in shares.values()] for mean in found]
    lines = [
        (
            *(mean.method, mean.setting, *(shown(error if error < inf else None) for error in mine)),
            *(shown(mean.worst), shown(mean.seconds and mean.seconds * 1e3), str(mean.failures or "-")),
        )
        for mean, mine in zip(found, errors)
    ]
    columns = range(len(shares))
    best = {(min(range(len(lines)), key=lambda i: errors[i][column]), column + 2) for column in columns}
    return Table(header, tuple(lines), frozenset(best))


def _worst_depth_error(rows: Sequence[Row], of: Mean) -> float:
    """The largest depth error of one setting; infinite where all its fits were refused."""
    mine = (row for row in rows if (row["method"], row["setting"]) == (of.method, of.setting) and not row["failed"])
    return max((row["depth_error"] for row in mine), default=inf)


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
    """The rasterizer: deviation from float64 against milliseconds, and what the thresholds of splatting cost."""
    swept = [row for row in rows if "thresholds" in row]
    plain = [row for row in rows if "thresholds" not in row]
    header = ("method", "scene", "forward ms", "forward + backward ms", "survey ms", "peak MB", "colour p99.9")
    figures = {"raster": figure([raster_plot(plain)], "Rasterizer error against time")}
    details: tuple[tuple[str, Table], ...] = ()
    if swept:
        error, time = "colour error, p99.9", "forward + backward, ms"
        plots = [work_precision(mine, case, error, time, 1e3) for case, mine in cases_of(swept).items()]
        title = "Cost of the thresholds of splatting"
        figures["raster-thresholds"] = figure(plots, title, columns=2, size=(480, 320))
        details = (("Thresholds, mean over scenes and sizes", means_table(swept, error, "ms", 1e3)),)
    return Section(
        "raster",
        "Rasterizer: time and precision",
        "Median wall time. The error is the 99.9th percentile of the colour's deviation (0..1) from the same image in "
        "float64; the worst gradient is the largest relative L2 deviation of any input's gradient, without the pixels "
        "where rounding decided a threshold differently. The thresholds (contributions below alpha are left out, a "
        "pixel is finished at a transmittance T) are compared with an image that has next to none.",
        figures,
        (("Every scene and size", Table((*header, "worst gradient"), tuple(map(_raster_cells, plain)))),),
        details,
        sources_of(rows),
    )


def raster_plot(rows: Sequence[Row]) -> Plot:
    """One mark per scene and size; scenes are not compared, so none is faded."""
    drawn = [row for row in rows if row["error"] and row["seconds"]]
    points = {name: tuple(_raster_point(row) for row in drawn if row["method"] == name) for name in colors_of(drawn)}
    every = [point for mine in points.values() for point in mine]
    x = Axis.around("forward + backward, ms", [point.x for point in every], log=True)
    y = Axis.around("colour error against float64, p99.9", [point.y for point in every], log=True)
    series = (Series(name, mine, color=color) for color, (name, mine) in enumerate(points.items()))
    return Plot("Every scene and size", x, y, tuple(series))


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

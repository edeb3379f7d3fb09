"""`python -m benchmarks report`: the page of `d2 report`, with the rows of all benchmarks as well.

Files of rows (runs.jsonl) and output folders of `d2 train` make one page of plots and tables.
"""

from collections.abc import Callable, Sequence

from benchmarks import align, raster, scaling, stereo
from benchmarks.gpu import proof
from benchmarks.never_worse import bench as never_worse
from benchmarks.priors_section import priors
from benchmarks.rivals import sweep as sweep_of_rivals
from benchmarks.stability import sweep
from benchmarks.work_precision import colors_of, work_precision
from d2_plugin.runs.report import report
from d2_plugin.runs.report.page import Section, sources_of
from d2_plugin.runs.report.report import BUILDERS, Builder, ReportSettings
from d2_plugin.runs.report.svg import Plot, figure
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import Table

__all__ = ["ReportSettings", "run"]

PLOTTED_ANCHORS = 20_000
"""Number of anchors that is plotted, or the nearest one that was measured."""

GPU = "Each step is a command of its own; what it measured, such as the rows of the rasterizer, is in that section."
STABILITY = (
    "Each parameter is swept to where other codebases break. ok: the error is below the sweep's limit; gap: it is "
    "above, and finite; failure: not finite, or refused where it should not be. Nothing is clamped in silence."
)
GROWTH = "Priors should take no more than linearly longer, and training no more memory: frames are read when needed."


def section(
    name: str,
    title: str,
    text: str,
    tables: Callable[[Sequence[Row]], list[tuple[str, Table]]],
    plot: Callable[[Sequence[Row]], tuple[Plot, str]] | None = None,
) -> Builder:
    """What makes a section of tables from the rows of one kind, and a figure if there is a plot with its title."""

    def build(rows: Sequence[Row]) -> Section:
        figures = {}
        if plot is not None:
            drawn, said = plot(rows)
            figures = {name: figure([drawn], said)}
        return Section(name, title, text, figures, tuple(tables(rows)), sources_of(rows))

    return build


def alignment(rows: Sequence[Row]) -> Section:
    """The fit: objective gap and error of aligned depth against milliseconds, one plot per share of wrong anchors."""
    anchors = min({row["anchors"] for row in rows}, key=lambda count: abs(count - PLOTTED_ANCHORS))
    chosen = [row for row in rows if row["anchors"] == anchors]
    shares, colors = sorted({row["outliers"] for row in chosen}), colors_of(rows)
    worse = [{**row, "error": row["depth_error"]} for row in chosen]
    plots = [
        work_precision(
            [row for row in of if row["outliers"] == share], f"{share:.0%} wrong", label, "ms per fit", 1e3, colors
        )
        for label, of in (("F / F* - 1", chosen), ("depth error", worse))
        for share in shares
    ]
    drawn = figure(plots, "Gap and depth error of alignment", columns=len(shares), size=(276, 270))
    title = f"Alignment: the positive-scale Charbonnier fit (plots: {anchors} anchors)"
    return Section("alignment", title, align.CAPTION, {"alignment": drawn}, tuple(align.tables(rows)), sources_of(rows))


def stereo_plot(rows: Sequence[Row]) -> tuple[Plot, str]:
    """Geometric depth after the common filter: 1 - F against CPU seconds per view, mean over rigs."""
    plot = work_precision(rows, "Mean over rigs", "1 - F at 1 %", "CPU seconds per view")
    return plot, "1 - F against CPU time of stereo"


def raster_plot(rows: Sequence[Row]) -> tuple[Plot, str]:
    """Deviation from float64 against milliseconds."""
    plot = work_precision(rows, "Mean over scenes and sizes", "colour error, p99.9", "forward + backward, ms", 1e3)
    return plot, "Rasterizer error against time"


EVERY = BUILDERS | {
    "sweep": section("sweep", "Rivals at their best", sweep_of_rivals.CAPTION, sweep_of_rivals.tables),
    "never_worse": section("never_worse", "Never worse than without", never_worse.CAPTION, never_worse.tables),
    "alignment": alignment,
    "stereo": section(
        *("stereo", "Stereo: geometric depth", stereo.CAPTION, lambda rows: stereo.tables(rows)[:1], stereo_plot)
    ),
    "priors": priors,
    "raster": section("raster", "Rasterizer: time and precision", raster.CAPTION, raster.tables, raster_plot),
    "gpu": section("gpu", "On a GPU", GPU, proof.tables),
    "stability": section("stability", "Stability: stiff and extreme cases", STABILITY, sweep.tables),
    "scaling": section("scaling", "Scaling: growth with the number of frames", GROWTH, scaling.tables),
}
"""What makes the section of each kind of row, in the order of the page."""


def run(settings: ReportSettings) -> str:
    """Make the report; how many rows it holds, and which files it is."""
    return report.run(settings, EVERY)

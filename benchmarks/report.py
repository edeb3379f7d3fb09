"""`python -m benchmarks report`: the page of `d2 report`, with the rows of all benchmarks as well.

Files of rows (runs.jsonl) and output folders of `d2 train` make one page of plots and tables.
"""

from collections.abc import Sequence

from benchmarks import align, raster, scaling, stereo, training_step
from benchmarks.gpu import proof
from benchmarks.never_worse import bench as never_worse_bench
from benchmarks.priors_section import priors
from benchmarks.rivals import sweep as sweep_of_rivals
from benchmarks.stability import sweep
from benchmarks.work_precision import colors_of, work_precision
from d2_plugin.runs.report import report
from d2_plugin.runs.report.page import Section, sources_of
from d2_plugin.runs.report.report import BUILDERS, ReportSettings
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.rows import Row

__all__ = ["ReportSettings", "run"]

PLOTTED_ANCHORS = 20_000
"""Number of anchors that is plotted, or the nearest one that was measured."""


def never_worse(rows: Sequence[Row]) -> Section:
    """D² with wrong monocular maps beside stereo alone and the backbone alone."""
    tables = [("Scores", never_worse_bench.table(rows))]
    return _section("never_worse", "Never worse than without", never_worse_bench.CAPTION, rows, {}, tables)


def rivals_swept(rows: Sequence[Row]) -> Section:
    """Each rival as published and at its best, by a sweep of weight and schedule."""
    return _section(
        "sweep", "Rivals at their best", sweep_of_rivals.CAPTION, rows, {}, [("Swept", sweep_of_rivals.table(rows))]
    )


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
    return _section("alignment", title, align.CAPTION, rows, {"alignment": drawn}, align.tables(rows))


def stereo_depth(rows: Sequence[Row]) -> Section:
    """Geometric depth after the common filter: 1 - F against CPU seconds per view, mean over rigs."""
    plot = work_precision(rows, "Mean over rigs", "1 - F at 1 %", "CPU seconds per view")
    drawn = figure([plot], "1 - F against CPU time of stereo")
    return _section(
        "stereo", "Stereo: geometric depth", stereo.CAPTION, rows, {"stereo": drawn}, stereo.tables(rows)[:1]
    )


def rasterizer(rows: Sequence[Row]) -> Section:
    """Deviation from float64 against milliseconds."""
    plot = work_precision(rows, "Mean over scenes and sizes", "colour error, p99.9", "forward + backward, ms", 1e3)
    drawn = {"raster": figure([plot], "Rasterizer error against time")}
    tables = [("Every scene and size", raster.table(rows))]
    return _section("raster", "Rasterizer: time and precision", raster.CAPTION, rows, drawn, tables)


def step(rows: Sequence[Row]) -> Section:
    """One training step beside the rasterizer's own forward and backward, in CPU time."""
    text = (
        "The rasterizer alone, a bare step and a step with the depth loss run in turn in one process on a synthetic "
        "scene whose Gaussians stay as they are. What counts is the ratio: the machine is shared."
    )
    return _section("step", "A training step", text, rows, {}, [("Steps", training_step.table(rows))])


def gpu(rows: Sequence[Row]) -> Section:
    """What is known of the CUDA kernels: steps that ran on a device, and what nvcc says of them without one."""
    text = (
        "Static analysis is what the compiler says of a kernel, and no measurement: nothing here has run on a GPU "
        "unless a step below says so."
    )
    return _section("gpu", "The GPU kernels", text, rows, {}, proof.tables(rows))


def stability(rows: Sequence[Row]) -> Section:
    """Sweeps to where numbers end, float32 beside float64."""
    text = (
        "Each parameter is swept to where other codebases break. ok: the error is below the sweep's limit; gap: it is "
        "above, and finite; failure: not finite, or refused where it should not be. Nothing is clamped in silence."
    )
    return _section("stability", "Stability: stiff and extreme cases", text, rows, {}, sweep.tables(rows))


def growth(rows: Sequence[Row]) -> Section:
    """How time and memory grow with the number of frames."""
    text = "Priors should take no more than linearly longer, and training no more memory: frames are read when needed."
    title = "Scaling: growth with the number of frames"
    return _section("scaling", title, text, rows, {}, [("Measured", scaling.table(rows))])


def _section(name: str, title: str, text: str, rows: Sequence[Row], figures: dict[str, str], tables: list) -> Section:
    return Section(name, title, text, figures, tuple(tables), sources_of(rows))


EVERY = BUILDERS | {
    **{
        "sweep": rivals_swept,
        "never_worse": never_worse,
        "alignment": alignment,
        "stereo": stereo_depth,
        "priors": priors,
    },
    **{"raster": rasterizer, "step": step, "gpu": gpu, "stability": stability, "scaling": growth},
}
"""What makes the section of each kind of row, in the order of the page."""


def run(settings: ReportSettings) -> str:
    """Make the report; how many rows it holds, and which files it is."""
    return report.run(settings, EVERY)

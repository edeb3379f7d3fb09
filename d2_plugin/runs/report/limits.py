"""The parts of the report about limits: where numbers end, what a scene does not need, how work grows with frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

from d2_plugin.runs.growth import power
from d2_plugin.runs.markup import Table
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series, number
from d2_plugin.runs.report.sections import Section, cases_of, distinct, sources_of
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.report.work_precision import SMALLEST, colors_of, growth, shown
from d2_plugin.runs.rows import Row
from d2_plugin.runs.verdict import Margin


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
        headlines=(_stability_headline(rows),),
    )


def _stability_headline(rows: Sequence[Row]) -> str:
    count = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in ("ok", "gap", "failure")}
    where = ", ".join(dict.fromkeys(f"{row['case']} in {row['method']}" for row in rows if row["verdict"] != "ok"))
    told = f"{count['ok']} of {len(rows)} points ok, {count['gap']} gaps, {count['failure']} failures"
    return told + (f" ({where})" if where else "")


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
    """What is left out: its saving and its cost on the recording, measured with and without."""
    header = ("recording", "decision", "by the plan", "s", "peak MB", "Gaussians", "cost of leaving it out", "verdict")
    decisions = dict.fromkeys((row["case"], row["method"]) for row in rows)
    cells = tuple(_decision([row for row in rows if (row["case"], row["method"]) == key]) for key in decisions)
    return Section(
        "plan",
        "Scene plan: what is left out",
        "Each decision of the plan, taken both ways on the recording: time, memory and Gaussians with the part → "
        "without it, and what leaving it out costs (negative: it gains), as mean ± deviation over the seeds. The "
        "verdict needs at least three seeds and a cost beyond two standard errors.",
        tables=(("Decisions", Table(header, cells)),),
        sources=sources_of(rows),
    )


def _decision(rows: Sequence[Row]) -> tuple[str, ...]:
    """One line of the table: with the part, an arrow, and without it."""
    names = ("seconds", "peak_mb", "gaussians")
    both = ("-" if rows[0].get(n) is None else " → ".join(_rounded(row[n]) for row in rows) for n in names)
    first, last = rows[0], rows[-1]
    cost = first["failed"] or ("-" if last["cost"] is None else f"{last['cost']:+.3f}{_spread(last)} {last['unit']}")
    return (first["case"], first["method"], first["planned"], *both, cost, _plan_verdict(last))


def _plan_verdict(row: Row) -> str:
    """What the cost of leaving a part out says; its differences were taken seed by seed."""
    if row["failed"] or row["cost"] is None:
        return "-"
    seeds = row.get("seeds")
    if seeds is None:
        return "built once: no verdict"
    deviation = row.get("cost_deviation")
    error = None if deviation is None else deviation / math.sqrt(len(seeds))
    verdict = Margin(row["cost"], error, len(seeds)).verdict
    return {"holds": "costs", "fails": "gains"}.get(verdict, verdict)


def _spread(row: Row) -> str:
    return "" if row.get("cost_deviation") is None else f" ± {row['cost_deviation']:.3f}"


def _rounded(value: float) -> str:
    """A count as it is, anything else in three digits."""
    return str(value) if isinstance(value, int) else shown(value)


def scaling(rows: Sequence[Row]) -> Section:
    """How time and memory grow with the number of frames."""
    lengths, plots, cells = distinct(rows, "frames"), [], []
    for name, label in (("seconds", "seconds"), ("peak_mb", "peak MB")):
        lines = {
            part: [(row["frames"], row[name]) for row in rows if row["method"] == part and row.get(name)]
            for part in colors_of(rows)
        }
        plots.append(growth(label, "frames", label, lines))
        for part, line in lines.items():
            measured = [shown(dict(line).get(length)) for length in lengths]
            cells.append((part, label, *measured, power(line, "frames") or "-"))
    header = ("part", "of", *(f"{length:g} frames" for length in lengths), "grows as")
    return Section(
        "scaling",
        "Scaling: growth with the number of frames",
        "Priors should take no more than linearly longer, and training no more memory: frames are read when needed.",
        {"scaling": figure(plots, "Time and memory over the number of frames", columns=2, size=(400, 320))},
        (("Measured", Table(header, tuple(cells))),),
        sources=sources_of(rows),
        headlines=("; ".join(f"{cell[0]}, {cell[1]}: as {cell[-1]}" for cell in cells if cell[-1] != "-"),),
    )


def step(rows: Sequence[Row]) -> Section:
    """One training step beside the rasterizer's own forward and backward, in CPU time."""
    header = ("scene", "work", "threads", "CPU ms", "in rasterizer passes", "peak MB")
    cells = tuple(
        (
            *(row["case"], row["method"], str(row["threads"]), number(row["passes"]["step"]["cpu_ms"])),
            *(f"{row['ratio']:.2f}", shown(row["peak_mb"])),
        )
        for row in rows
    )
    return Section(
        "step",
        "A training step",
        "The rasterizer alone, a bare step and a step with the depth loss run in turn in one process on a synthetic "
        "scene whose Gaussians stay as they are. What counts is the ratio: the machine is shared. The views "
        "were all seen before, so the search for the known pixels of a view, once for each, is not in it.",
        tables=(("Steps", Table(header, cells)),),
        sources=sources_of(rows),
    )


def gpu(rows: Sequence[Row]) -> Section:
    """What is known of the CUDA kernels: steps that ran on a device, and what nvcc says of them without one."""
    compiled = [row for row in rows if "registers" in row]
    kernels = tuple(
        (
            *(row["case"].rpartition(" ")[2], row["setting"], str(row["registers"]), str(row["spill_bytes"])),
            *(str(row["shared_bytes"]), str(row["instructions"]), str(row.get("fragment_instructions") or "-")),
        )
        for row in compiled
    )
    steps = tuple((row["case"], row["device"] or "-", row["failed"] or "done") for row in rows if row not in compiled)
    header = ("kernel", "target", "registers", "spilled bytes", "shared bytes", "instructions", "for a fragment")
    return Section(
        "gpu",
        "The GPU kernels",
        "Static analysis is what the compiler says of a kernel, and no measurement: nothing here has run on a GPU "
        "unless a step below says so.",
        tables=(("Static analysis", Table(header, kernels)), ("Steps", Table(("step", "device", "result"), steps))),
        sources=sources_of(rows),
    )

"""`d2 bench align`: error against run time of the fit that aligns monocular to geometric depth."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any, NamedTuple, get_args

import torch

from benchmarks.align_measure import AlignMethod, AlignProblem, align_problem, measure, methods
from d2_plugin.durable import make_folder
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.recordings.recording import MonoKind
from d2_plugin.runs.command_line import command_line
from d2_plugin.runs.markup import Table, markdown
from d2_plugin.runs.provenance import provenance
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.report.work_precision import colors_of, growth, work_precision
from d2_plugin.runs.rows import Row, append_rows, make_row
from d2_plugin.settings import AtATime, NotNegative, Range, Settings, Share

logger = logging.getLogger(__name__)

PLOTTED_ANCHORS = 10_000
"""Number of anchors that is plotted, or the nearest one that was measured."""


@dataclass(frozen=True)
class AlignBench(Settings):
    """Settings of `d2 bench align`."""

    anchors: tuple[Annotated[int, Range(1)], ...] = (100, 1_000, 20_000, 100_000)
    """Numbers of anchors."""
    outliers: tuple[Share, ...] = (0.0, 0.2, 0.4, 0.6)
    """Shares of the anchors that are wrong."""
    methods: tuple[str, ...] = ()
    """Names of methods as the table shows them; all if not given."""
    seeds: Annotated[int, Range(1)] = 3
    """Problems per case; figures are medians over them."""
    seconds: NotNegative = 0.03
    """Time for which each fit is repeated, seconds."""
    threads: AtATime | None = None
    """CPU threads of torch; if not given, torch chooses. The fits themselves use one."""
    output: Path = Path("bench-align")
    """Folder of the results."""


class AlignCase(NamedTuple):
    """What the map is, the number of anchors, and the share of them that is wrong."""

    domain: MonoKind
    anchors: int
    outliers: float

    def __str__(self) -> str:
        return f"{self.domain} map, {self.anchors} anchors, {self.outliers:.0%} wrong"


def run(settings: AlignBench) -> str:
    """Measure; the table, and where rows, table and plot lie."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    rows = bench_align(
        settings.output,
        anchors=settings.anchors,
        outliers=settings.outliers,
        names=settings.methods,
        seeds=settings.seeds,
        budget=settings.seconds,
        command=command_line("bench align", settings),
    )
    return f"{table(rows)}\nalign.jsonl (rows), align.md (this table) and align.svg (plot) are in {settings.output}"


def bench_align(
    output: Path,
    *,
    anchors: Sequence[int] = AlignBench.anchors,
    outliers: Sequence[float] = AlignBench.outliers,
    kinds: Sequence[MonoKind] = get_args(MonoKind),
    names: Sequence[str] = (),
    seeds: int = AlignBench.seeds,
    budget: float = AlignBench.seconds,
    command: str = "",
) -> list[Row]:
    """Measure and write `align.jsonl`, `align.md` and `align.svg` into `output`.

    Args:
        output: folder, created where absent; its three files are replaced.
        anchors: numbers of anchors.
        outliers: shares of them that are wrong, 0..1.
        kinds: `relative` fits inverse depth, `metric` depth.
        names: of `align_measure.methods`; all where empty.
        seeds: problems per case; figures are medians over them.
        budget: seconds for which each fit is repeated.
        command: how this was started, for the captions.

    Returns:
        One row per method and case: `error` is F / F* - 1, `depth_error` the median relative error of aligned depth.
    """
    chosen = _chosen(names)
    make_folder(output)
    (output / "align.jsonl").unlink(missing_ok=True)
    rows: list[Row] = []
    for case in (AlignCase(*values) for values in _product(kinds, anchors, outliers)):
        problems = [align_problem(*case, seed=seed) for seed in range(seeds)]
        found = [_row(method, case, problems, budget, command) for method in chosen]
        append_rows(output / "align.jsonl", found)
        rows += found
        logger.info("%s is measured", case)
    (output / "align.md").write_text(table(rows))
    (output / "align.svg").write_text(plot(rows))
    return rows


def _product(
    kinds: Sequence[MonoKind], anchors: Sequence[int], outliers: Sequence[float]
) -> Iterable[tuple[MonoKind, int, float]]:
    return ((kind, count, share) for kind in kinds for count in anchors for share in outliers)


def _chosen(names: Sequence[str]) -> list[AlignMethod]:
    every = methods()
    known = dict.fromkeys(method.name for method in every)
    for name in names:
        if name not in known:
            raise unknown_name("alignment method", name, known)
    return [method for method in every if not names or method.name in names]


def _row(method: AlignMethod, case: AlignCase, problems: list[AlignProblem], budget: float, command: str) -> Row:
    found: dict[str, Any] = {"error": None, "seconds": None, "depth_error": None}
    failed = None
    try:
        gap, depth_error, seconds = measure(method, problems, budget)
        found = {"error": gap, "seconds": seconds, "depth_error": depth_error}
    except D2Error as error:
        failed = str(error)
    details = {"residual": method.residual, "seeds": len(problems), **case._asdict()}
    return make_row(
        "alignment", str(case), method.name, method.setting, failed=failed, command=command, **found, **details
    )


def table(rows: Sequence[Row]) -> str:
    """Markdown: per method and setting the depth error by share of wrong anchors, and the time by their number."""
    shares = sorted({row["outliers"] for row in rows})
    counts = sorted({row["anchors"] for row in rows})
    caption = (
        "Depth error: median over the view of the relative error of aligned depth that is due to the line, mean over "
        "the numbers of anchors; monocular values carry 2 % of noise. Gap: F / F* - 1, the worst case, in the "
        "objective that the method minimises or would be compared in. Time: median wall time of one fit. "
        f"{provenance(rows[0])}"
    )
    header = ("method", "setting", *(f"{share:.0%} wrong" for share in shares), "worst gap")
    header += tuple(f"{count} anchors, ms" for count in counts)
    parts = [caption]
    for kind in dict.fromkeys(row["domain"] for row in rows):
        mine = [row for row in rows if row["domain"] == kind]
        lines = tuple(_cells(key, group, shares, counts) for key, group in _by_setting(mine).items())
        parts += [f"{kind.capitalize()} map", markdown(Table(header, lines))]
    return "\n\n".join(parts) + "\n"


def _by_setting(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    keys = dict.fromkeys((row["method"], row["setting"]) for row in rows)
    return {key: [row for row in rows if (row["method"], row["setting"]) == key] for key in keys}


def _cells(
    key: tuple[str, str], group: Sequence[Row], shares: Sequence[float], counts: Sequence[int]
) -> tuple[str, ...]:
    """One line of the table; cases that the method refused are counted apart."""
    errors = [_depth_error([row for row in group if row["outliers"] == share]) for share in shares]
    worked = [row for row in group if not row["failed"]]
    gap = f"{max(row['error'] for row in worked):.0e}" if worked else "-"
    times = [_milliseconds(worked, count) for count in counts]
    return (*key, *errors, gap, *("-" if time is None else f"{time:.2f}" for time in times))


def _milliseconds(rows: Sequence[Row], anchors: int) -> float | None:
    """Median time of a fit of so many anchors, None where there was none."""
    times = [1000 * row["seconds"] for row in rows if row["anchors"] == anchors]
    return median(times) if times else None


def _depth_error(rows: Sequence[Row]) -> str:
    """Mean over the cases that the method took on, and how many it refused."""
    errors = [row["depth_error"] for row in rows if not row["failed"]]
    refused = len(rows) - len(errors)
    told = f"{mean(errors):.4f}" if errors else "-"
    return f"{told} ({refused} of {len(rows)} refused)" if refused else told


def plot(rows: Sequence[Row]) -> str:
    """SVG: objective gap and depth error against time, and time against the number of anchors; lower left is better.

    The first two plots show the number of anchors nearest to `PLOTTED_ANCHORS`; the depth error is that with the
    largest share of wrong anchors. Means are geometric, over the kinds of map and, for the gap, over the shares.
    """
    anchors = min({row["anchors"] for row in rows}, key=lambda count: abs(math.log(count / PLOTTED_ANCHORS)))
    worst = max(row["outliers"] for row in rows)
    mine, colors = [row for row in rows if row["anchors"] == anchors], colors_of(rows)
    hard = [{**row, "error": row["depth_error"]} for row in mine if row["outliers"] == worst]
    panels = (
        work_precision(mine, f"{anchors} anchors", "F / F* - 1", "ms per fit", 1e3, colors),
        work_precision(hard, f"{anchors} anchors, {worst:.0%} wrong", "depth error", "ms per fit", 1e3, colors),
        growth("Slowest setting of each method", "anchors", "ms per fit", _times(rows, colors)),
    )
    return figure(panels, "Alignment: gap, depth error and time of the fits", columns=3, size=(380, 320))


def _times(rows: Sequence[Row], names: Iterable[str]) -> Mapping[str, list[tuple[float, float]]]:
    """Median milliseconds over the number of anchors, of the setting of each method that takes longest."""
    counts = sorted({row["anchors"] for row in rows})
    lines = {}
    for name in names:
        worked = [row for row in rows if row["method"] == name and not row["failed"]]
        found = [
            [(count, time) for count in counts if (time := _milliseconds(group, count)) is not None]
            for group in _by_setting(worked).values()
        ]
        lines[name] = max(found, key=lambda line: line[-1][1], default=[])
    return lines

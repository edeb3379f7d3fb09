"""`d2 bench align`: error against run time of the fit that aligns monocular to geometric depth."""

from __future__ import annotations

import argparse
import logging
import math
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple, get_args

import torch

from d2_plugin.captures.capture import MonoKind
from d2_plugin.errors import D2Error, MissingExtra, missing_extra, unknown_name
from d2_plugin.runs.provenance import provenance
from d2_plugin.study.rows import append_rows, make_row

from .align_measure import AlignMethod, align_problem, measure, methods

logger = logging.getLogger(__name__)

ANCHORS = (100, 1_000, 20_000, 100_000)
OUTLIERS = (0.0, 0.2, 0.4, 0.6)
SEEDS = 3
DRAWN_GAP = 1e-13
"""Smallest objective gap of the plot; what is closer to the optimum is drawn here."""


class AlignCase(NamedTuple):
    """What the map is, the number of anchors, and the share of them that is wrong."""

    domain: MonoKind
    anchors: int
    outliers: float

    def __str__(self) -> str:
        return f"{self.domain} map, {self.anchors} anchors, {self.outliers:.0%} wrong"


def bench_align(
    output: Path,
    *,
    anchors: Sequence[int] = ANCHORS,
    outliers: Sequence[float] = OUTLIERS,
    kinds: Sequence[MonoKind] = get_args(MonoKind),
    names: Sequence[str] = (),
    seeds: int = SEEDS,
    budget: float = 0.03,
    command: str = "",
) -> list[dict[str, Any]]:
    """Measure and write `align.jsonl`, `align.md` and, where matplotlib is installed, `align.svg` into `output`.

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
    output.mkdir(parents=True, exist_ok=True)
    (output / "align.jsonl").unlink(missing_ok=True)
    rows: list[dict[str, Any]] = []
    for case in (AlignCase(*values) for values in _product(kinds, anchors, outliers)):
        problems = [align_problem(*case, seed=seed) for seed in range(seeds)]
        found = [_row(method, case, problems, budget, command) for method in chosen]
        append_rows(output / "align.jsonl", found)
        rows += found
        logger.info("%s is measured", case)
    (output / "align.md").write_text(table(rows))
    try:
        plot(rows, output / "align.svg")
    except MissingExtra as error:
        logger.warning("no plot: %s", error)
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


def _row(method: AlignMethod, case: AlignCase, problems: list, budget: float, command: str) -> dict[str, Any]:
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


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: per method and setting the depth error by share of wrong anchors, and the time by their number."""
    shares = sorted({row["outliers"] for row in rows})
    counts = sorted({row["anchors"] for row in rows})
    caption = (
        "Depth error: median over the view of the relative error of aligned depth that is due to the line, mean over "
        "the numbers of anchors; monocular values carry 2 % of noise. Gap: F / F* - 1, the worst case, in the "
        "objective that the method minimises or would be compared in. Time: median wall time of one fit. "
        f"{provenance(rows[0])}"
    )
    parts = [caption, ""]
    for kind in dict.fromkeys(row["domain"] for row in rows):
        mine = [row for row in rows if row["domain"] == kind]
        header = ["method", "setting", *(f"{share:.0%} wrong" for share in shares), "worst gap"]
        header += [f"{count} anchors, ms" for count in counts]
        parts += [f"{kind.capitalize()} map", "", _line(header), _line(["---"] * len(header))]
        parts += [_line(_cells(key, group, shares, counts)) for key, group in _grouped(mine)]
        parts.append("")
    return "\n".join(parts)


def _grouped(rows: Sequence[dict[str, Any]]) -> list[tuple[tuple[str, str], list[dict[str, Any]]]]:
    keys = dict.fromkeys((row["method"], row["setting"]) for row in rows)
    return [(key, [row for row in rows if (row["method"], row["setting"]) == key]) for key in keys]


def _cells(
    key: tuple[str, str], group: Sequence[dict[str, Any]], shares: Sequence[float], counts: Sequence[int]
) -> list[str]:
    """One line of the table; cases that the method refused are counted apart."""
    cells = [_depth_error([row for row in group if row["outliers"] == share]) for share in shares]
    worked = [row for row in group if not row["failed"]]
    cells.append(f"{max(row['error'] for row in worked):.0e}" if worked else "-")
    for count in counts:
        times = [1000 * row["seconds"] for row in worked if row["anchors"] == count]
        cells.append(f"{median(times):.2f}" if times else "-")
    return [*key, *cells]


def _depth_error(rows: Sequence[dict[str, Any]]) -> str:
    """Mean over the cases that the method took on, and how many it refused."""
    errors = [row["depth_error"] for row in rows if not row["failed"]]
    refused = len(rows) - len(errors)
    told = f"{mean(errors):.4f}" if errors else "-"
    return f"{told} ({refused} of {len(rows)} refused)" if refused else told


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Objective gap and depth error against time, and time against the number of anchors; lower left is better.

    The first two panels show the number of anchors nearest to 10,000, one mark per setting: the gap's worst case and
    the depth error with the largest share of wrong anchors, both over the domains.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_extra("matplotlib", "report", "the plot") from None
    worked = [row for row in rows if not row["failed"]]
    anchors = min({row["anchors"] for row in rows}, key=lambda count: abs(math.log(count / 10_000)))
    worst = max(row["outliers"] for row in rows)
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    gap, depth, scaling = figure.subplots(1, 3)
    for name in dict.fromkeys(row["method"] for row in worked):
        mine = [row for row in worked if row["method"] == name]
        _scatter(gap, name, [row for row in mine if row["anchors"] == anchors], "error", max)
        hard = [row for row in mine if row["anchors"] == anchors and row["outliers"] == worst]
        _scatter(depth, name, hard, "depth_error", mean)
        last = [group for _, group in _grouped(mine)][-1]
        counts = sorted({row["anchors"] for row in last})
        times = [median(1000 * row["seconds"] for row in last if row["anchors"] == count) for count in counts]
        scaling.plot(counts, times, marker="o", label=f"{name}, {last[0]['setting']}")
    gap.set(xlabel=f"ms per fit of {anchors} anchors", ylabel="worst objective gap F / F* - 1")
    depth.set(xlabel=f"ms per fit of {anchors} anchors", ylabel=f"median depth error, {worst:.0%} of the anchors wrong")
    scaling.set(xlabel="anchors", ylabel="ms per fit")
    for panel in (gap, depth, scaling):
        panel.set(xscale="log", yscale="log")
        panel.grid(True, which="both", alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=6)
    figure.supxlabel(provenance(rows[0]), fontsize=6, wrap=True)
    figure.savefig(path, metadata={"Date": None})


def _scatter(panel: Any, name: str, rows: Sequence[dict[str, Any]], value: str, unite: Any) -> None:
    """One mark per setting of one method, with the setting beside it."""
    groups = _grouped(rows)
    if not groups:
        return
    times = [median(1000 * row["seconds"] for row in group) for _, group in groups]
    values = [max(unite(row[value] for row in group), DRAWN_GAP) for _, group in groups]
    panel.scatter(times, values, label=name)
    for ((_, setting), _), x, y in zip(groups, times, values):
        panel.annotate(setting, (x, y), fontsize=5, xytext=(3, 3), textcoords="offset points")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `d2 bench align`."""
    parser = argparse.ArgumentParser(prog="d2 bench align", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("bench-align"), help="folder of the results")
    parser.add_argument("--anchors", nargs="+", type=int, default=ANCHORS, metavar="N", help="numbers of anchors")
    parser.add_argument(
        "--outliers", nargs="+", type=float, default=OUTLIERS, metavar="SHARE", help="shares of wrong anchors, 0..1"
    )
    parser.add_argument("--methods", nargs="+", default=(), metavar="METHOD", help="names in the table; default all")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="problems per case; figures are medians over them")
    parser.add_argument("--seconds", type=float, default=0.03, help="for which each fit is repeated")
    parser.add_argument("--threads", type=int, help="CPU threads of torch; default: torch's. The fits use one")
    options = parser.parse_args(argv)
    if options.threads:
        torch.set_num_threads(options.threads)
    bench_align(
        options.output,
        anchors=options.anchors,
        outliers=options.outliers,
        names=options.methods,
        seeds=options.seeds,
        budget=options.seconds,
        command=shlex.join(["d2", "bench", "align", *(argv if argv is not None else ())]),
    )
    logger.info("results are in %s", options.output)
    return 0

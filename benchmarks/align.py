"""`python -m benchmarks align`: error against run time of the fit that aligns monocular to geometric depth."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any, NamedTuple, get_args

import torch

from benchmarks.align_measure import AlignMethod, AlignProblem, AlignScore, align_problem, measure, methods
from benchmarks.rows import begin_rows, grouped, told
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.recordings.recording import MonoKind
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table
from d2_plugin.settings import AtATime, NotNegative, Range, Settings, Share

logger = logging.getLogger(__name__)

CAPTION = (
    "Depth error: median over the view of the relative error of aligned depth that is due to the line, mean over "
    "the numbers of anchors; monocular values carry 2 % of noise. Gap: F / F* - 1, the worst case, in the "
    "objective that the method minimises or would be compared in. Time: median wall time of one fit."
)


@dataclass(frozen=True)
class AlignBench(Settings):
    """Settings of `python -m benchmarks align`."""

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
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


class AlignCase(NamedTuple):
    """What the map is, the number of anchors, and the share of them that is wrong."""

    domain: MonoKind
    anchors: int
    outliers: float

    def __str__(self) -> str:
        return f"{self.domain} map, {self.anchors} anchors, {self.outliers:.0%} wrong"


def run(settings: AlignBench) -> str:
    """Measure and add the rows; the tables, and where the rows lie."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    begin_rows(settings.output)
    every = methods()
    known = dict.fromkeys(method.name for method in every)
    refuse_unknown("alignment method", settings.methods, known)
    chosen = [method for method in every if not settings.methods or method.name in settings.methods]
    command, rows = command_line("python -m benchmarks align", settings), list[Row]()
    kinds: tuple[MonoKind, ...] = get_args(MonoKind)
    for case in (AlignCase(k, n, share) for k in kinds for n in settings.anchors for share in settings.outliers):
        problems = [align_problem(*case, seed=seed) for seed in range(settings.seeds)]
        measured = [_row(method, case, problems, settings.seconds, command) for method in chosen]
        append_rows(settings.output, measured)
        rows += measured
        logger.info("%s is measured", case)
    return told(tables(rows), settings.output, CAPTION)


def _row(method: AlignMethod, case: AlignCase, problems: list[AlignProblem], budget: float, command: str) -> Row:
    found: dict[str, Any] = dict.fromkeys(AlignScore._fields)
    try:
        found = measure(method, problems, budget)._asdict()
    except D2Error as error:
        found["failed"] = str(error)
    found |= {"residual": method.residual, "seeds": len(problems), **case._asdict()}
    return make_row("alignment", str(case), method.name, method.setting, command=command, **found)


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """For each kind of map, per method and setting: depth error by share of wrong anchors, time by their number."""
    shares = sorted({row["outliers"] for row in rows})
    counts = sorted({row["anchors"] for row in rows})
    header = ("method", "setting", *(f"{share:.0%} wrong" for share in shares), "worst gap")
    header += tuple(f"{count} anchors, ms" for count in counts)
    made = []
    for (kind,), mine in grouped(rows, "domain").items():
        groups = grouped(mine, "method", "setting").items()
        lines = tuple(_cells(key, group, shares, counts) for key, group in groups)
        made.append((f"{kind.capitalize()} map", Table(header, lines)))
    return made


def _cells(
    key: tuple[str, ...], group: Sequence[Row], shares: Sequence[float], counts: Sequence[int]
) -> tuple[str, ...]:
    """One line of the table; cases that the method refused are counted apart."""
    errors = [_depth_error([row for row in group if row["outliers"] == share]) for share in shares]
    worked = [row for row in group if not row["failed"]]
    gap = f"{max(row['error'] for row in worked):.0e}" if worked else "-"
    return (*key, *errors, gap, *(_milliseconds(worked, count) for count in counts))


def _milliseconds(rows: Sequence[Row], anchors: int) -> str:
    """Median time of a fit of so many anchors."""
    times = [1000 * row["seconds"] for row in rows if row["anchors"] == anchors]
    return f"{median(times):.2f}" if times else "-"


def _depth_error(rows: Sequence[Row]) -> str:
    """Mean over the cases that the method took on, and how many it refused."""
    errors = [row["depth_error"] for row in rows if not row["failed"]]
    refused = len(rows) - len(errors)
    text = f"{mean(errors):.4f}" if errors else "-"
    return f"{text} ({refused} of {len(rows)} refused)" if refused else text

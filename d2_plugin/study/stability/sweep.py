"""`d2 stability`: parameters swept to where numbers end, in float32 and float64, with the error of every point.

A point is `ok` where its error is below the sweep's limit, a `gap` where it is above and finite, and a `failure` where
something is not finite or is refused. Nothing is clamped in silence: each sweep names what is guarded, and how.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.progress import progress_bar
from d2_plugin.study.rows import Row, append_rows, make_row

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}

Measure = Callable[[float, torch.dtype], float]
"""The error at one value of the parameter, computed in that precision; not finite where the result is not."""


@dataclass(frozen=True)
class Sweep:
    """One parameter and how far it is driven."""

    name: str
    parameter: str
    """What is swept, with its unit."""
    values: tuple[float, ...]
    error: str
    """What the error is."""
    limits: dict[str, float]
    """Largest error that counts as ok, per precision; a precision without one is not measured."""
    guard: str
    """What keeps this finite, or that nothing does."""
    measure: Measure


def decades(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Powers of ten from 10^first to 10^last."""
    return tuple(10.0**power for power in range(first, last + 1, step))


def all_sweeps() -> list[Sweep]:
    """Every sweep of the study, Gaussians first, then priors."""
    from .gaussians import gaussian_sweeps
    from .priors import prior_sweeps

    return [*gaussian_sweeps(), *prior_sweeps()]


def measure(sweep: Sweep, value: float, precision: str, command: str = "") -> Row:
    """One point of a sweep as a row; whatever goes wrong is recorded in it."""
    start = time.perf_counter()
    error, failed = float("nan"), None
    try:
        error = float(sweep.measure(value, PRECISIONS[precision]))
    except D2Error as refusal:
        failed = f"refused: {refusal}"
    limit = sweep.limits[precision]
    row = make_row(
        *("stability", sweep.name, precision, f"{value:g}"),
        error=None if failed else error,
        seconds=time.perf_counter() - start,
        failed=failed,
        command=command,
        parameter=sweep.parameter,
        value=value,
        measures=sweep.error,
        limit=limit,
        guard=sweep.guard,
    )
    row["verdict"] = "failure" if row["failed"] else "ok" if error <= limit else "gap"
    return row


def run_sweeps(names: Sequence[str] = (), command: str = "") -> list[Row]:
    """All points of the named sweeps, of all sweeps where none is named.

    Raises:
        D2Error: there is no such sweep.
    """
    sweeps = all_sweeps()
    known = [sweep.name for sweep in sweeps]
    for name in names:
        if name not in known:
            raise unknown_name("sweep", name, known)
    points = [
        (sweep, value, precision)
        for sweep in sweeps
        if not names or sweep.name in names
        for precision in sweep.limits
        for value in sweep.values
    ]
    rows = []
    with progress_bar("stability", len(points)) as bar:
        for done, point in enumerate(points, start=1):
            rows.append(measure(*point, command))
            bar.update(done, point[0].name)
    return rows


def summary(rows: Sequence[Row]) -> str:
    """One line per sweep and precision: how many points are ok, which are not, and the largest error."""
    lines = []
    for case, method in dict.fromkeys((row["case"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["case"], row["method"]) == (case, method)]
        lost = [f"{row['verdict']} at {row['setting']}" for row in mine if row["verdict"] != "ok"]
        worst = max((row["error"] for row in mine if row["error"] is not None), default=float("nan"))
        shown = ", ".join([*lost[:4], *([f"and {len(lost) - 4} more"] if len(lost) > 4 else [])])
        ok = f"{len(mine) - len(lost):2}/{len(mine)} ok, worst {worst:.1e}"
        lines.append(f"{case:18} {method}  {ok}  {shown}".rstrip())
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `d2 stability`."""
    parser = argparse.ArgumentParser(prog="d2 stability", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs.jsonl"), help="rows are added to it; runs.jsonl")
    parser.add_argument(
        "--sweeps", nargs="+", default=(), metavar="NAME", help="; ".join(sweep.name for sweep in all_sweeps())
    )
    options = parser.parse_args(arguments)
    rows = run_sweeps(options.sweeps, shlex.join(["d2", "stability", *(arguments or ())]))
    append_rows(options.output, rows)
    sys.stdout.write(f"{summary(rows)}\nrows are in {options.output}; `d2 report {options.output}` shows them\n")
    return 0

"""`python -m benchmarks stability`: parameters swept to where numbers end, in float32 and float64, with the error of
every point.

A point is `ok` where its error is below the sweep's limit, a `gap` where it is above and finite, and a `failure` where
something is not finite or is refused. Nothing is clamped in silence: each sweep names what is guarded, and how.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.rows import begin_rows, grouped, told
from benchmarks.stability.definition import Sweep
from benchmarks.stability.gaussians import GAUSSIANS
from benchmarks.stability.priors import PRIORS
from benchmarks.work_precision import shown
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.progress import progress_bar
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table
from d2_plugin.settings import Settings

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}

SWEEPS: dict[str, Sweep] = {sweep.name: sweep for sweep in (*GAUSSIANS, *PRIORS)}
"""Every sweep of the study by name, Gaussians first, then priors."""


@dataclass(frozen=True)
class StabilitySettings(Settings):
    """Settings of `python -m benchmarks stability`."""

    sweeps: tuple[str, ...] = ()
    """Names of sweeps; all if not given. An unknown name shows the list."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


def run(settings: StabilitySettings) -> str:
    """Sweep and add the rows; the tables, and where the rows lie."""
    begin_rows(settings.output)
    rows = run_sweeps(settings.sweeps, command_line("python -m benchmarks stability", settings))
    append_rows(settings.output, rows)
    return told(tables(rows), settings.output)


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
    refuse_unknown("sweep", names, SWEEPS)
    points = [
        (sweep, value, precision)
        for name, sweep in SWEEPS.items()
        if not names or name in names
        for precision in sweep.limits
        for value in sweep.values
    ]
    rows = []
    with progress_bar("stability", len(points)) as bar:
        for done, point in enumerate(points, start=1):
            rows.append(measure(*point, command))
            bar.update(done, point[0].name)
    return rows


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """Each sweep in each precision, what is guarded and how, and the points that are not ok."""
    header = ("sweep", "precision", "parameter", "points", "ok", "largest error", "limit")
    sweeps = []
    for (case, method), mine in grouped(rows, "case", "method").items():
        values = [row["value"] for row in mine]
        worst = max((row["error"] for row in mine if row["error"] is not None), default=None)
        span = f"{mine[0]['parameter']}: {min(values):g} .. {max(values):g}"
        ok = sum(row["verdict"] == "ok" for row in mine)
        sweeps.append((case, method, span, str(len(mine)), str(ok), shown(worst), shown(mine[0]["limit"])))
    guards = tuple(dict.fromkeys((row["case"], row["measures"], row["guard"]) for row in rows))
    beyond = tuple(
        (row["case"], row["method"], f"{row['value']:g}", row["verdict"], shown(row["error"]), row["failed"] or "")
        for row in rows
        if row["verdict"] != "ok"
    )
    return [
        ("Sweeps", Table(header, tuple(sweeps))),
        ("Guards", Table(("sweep", "the error is", "what is guarded, and how"), guards)),
        *([("Not ok", Table(("sweep", "precision", "at", "verdict", "error", "why"), beyond))] if beyond else []),
    ]

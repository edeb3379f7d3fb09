"""`python -m benchmarks stereo`: error against run time of geometric depth, every setting behind the same
filter."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from benchmarks.rows import begin_rows, grouped, told
from benchmarks.stereo_measure import VARIANTS, measure
from benchmarks.stereo_rigs import FROM_DISK, RENDERED, load_rigs
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table
from d2_plugin.settings import AtATime, Range, Settings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class StereoBench(Settings):
    """Settings of `python -m benchmarks stereo`."""

    rigs: tuple[str, ...] = ()
    """Rendered: synthetic2, synthetic3, synthetic4. From --data: studio, art, laundry, motorcycle, teddy. All that are
    available if not given."""
    data: Path | None = None
    """Folder with the recordings studio/ and middlebury/."""
    defaults_only: bool = False
    """Leave out what is varied about the matcher."""
    width: Annotated[int, Range(32, unit="pixels")] = 320
    """Width of rendered images, which are 16:9, pixels."""
    threads: AtATime = 1
    """CPU threads."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where PatchMatch runs. Times are CPU seconds either way; rows of a GPU also have wall seconds."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


def run(settings: StereoBench) -> str:
    """Measure and add the rows, one per setting and rig; the tables, and where the rows lie."""
    torch.set_num_threads(settings.threads)
    begin_rows(settings.output)
    chosen = {
        name: replace(variant, patchmatch_device=settings.device)
        for name, variant in VARIANTS.items()
        if name == "default" or not settings.defaults_only
    }
    names = settings.rigs or (*RENDERED, *(FROM_DISK if settings.data else ()))
    about = {"device": settings.device, "command": command_line("python -m benchmarks stereo", settings)}
    rows: list[Row] = []
    for group in [load_rigs(name, settings.data, settings.width) for name in names]:
        for name, variant in chosen.items():
            rows.append(_row(measure(name, variant, group), **about))
            append_rows(settings.output, rows[-1:])
            logger.info("%s on %s is measured", name, rows[-1]["rig"])
    return told(tables(rows), settings.output, CAPTION)


def _row(found: dict[str, Any], **more: Any) -> Row:
    """What `measure` found, as a row of the study: error 1 - F, seconds of CPU time per view."""
    case = f"{found['rig']} at {found['width']}x{found['height']}"
    error, seconds = (None, None) if found["failed"] else (1 - found["f1"], found["cpu"])
    return make_row("stereo", case, error=error, seconds=seconds, **found, **more)


CAPTION = (
    "Completeness: share of the pixels that another view sees which have a depth after the filter. F: harmonic "
    "mean of the share of depths within 1 % of the truth and the share of co-visible pixels with such a depth. "
    "Time is of matching alone, per view. A rig on which a method failed counts with completeness and F of 0."
)


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """The mean over rigs per method and setting, then every rig."""
    header = ("matcher", "setting", "completeness", "F at 1 %", "median error", "off > 5 %", "CPU s", "CPU µs/pixel")
    groups = grouped(rows, "method", "setting").items()
    over_rigs = Table(header, tuple((*key, *_numbers(_mean(group))) for key, group in groups))
    return [
        ("Mean over rigs", over_rigs),
        ("Every rig", Table(("rig", "views", "size", *header), tuple(map(_cells, rows)))),
    ]


def _cells(row: Row) -> tuple[str, ...]:
    size = f"{row['width']}x{row['height']}"
    return (row["rig"], str(row["views"]), size, row["method"], row["setting"], *_numbers(row))


def _mean(group: Sequence[Row]) -> dict[str, Any]:
    """Means over rigs; a rig on which the method failed counts with completeness and F of 0 and says so."""
    worked = [row for row in group if not row["failed"]]
    mean: dict[str, Any] = {"failed": None if worked else "all"}
    for name in ("completeness", "f1"):
        mean[name] = sum(row[name] for row in worked) / len(group)
    for name in ("median", "wrong", "cpu", "microseconds_per_pixel"):
        values = [row[name] for row in worked if row[name] is not None]
        mean[name] = sum(values) / len(values) if values else None
    return mean


def _numbers(row: Row) -> list[str]:
    if row["failed"]:
        return ["failed", *["-"] * 5]
    forms = {"completeness": "{:.3f}", "f1": "{:.3f}", "median": "{:.5f}", "wrong": "{:.2%}", "cpu": "{:.2f}"}
    forms["microseconds_per_pixel"] = "{:.1f}"
    return ["-" if row[name] is None else form.format(row[name]) for name, form in forms.items()]

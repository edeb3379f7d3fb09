"""`d2 bench stereo`: error against run time of geometric depth, every matcher and setting behind the same filter."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from benchmarks.stereo_measure import Method, measure, methods
from benchmarks.stereo_rigs import ARCS, MIDDLEBURY, load_rigs
from d2_plugin.durable import make_folder
from d2_plugin.errors import unknown_name
from d2_plugin.runs.command_line import command_line
from d2_plugin.runs.markup import Table, markdown
from d2_plugin.runs.provenance import provenance
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.report.work_precision import work_precision
from d2_plugin.runs.rows import Row, append_rows, make_row
from d2_plugin.settings import AtATime, Range, Settings

logger = logging.getLogger(__name__)

RENDERED = tuple(f"synthetic{views}" for views in ARCS)
FROM_DISK = ("studio", *MIDDLEBURY)
DRAWN_SHARE = 1e-4
"""Smallest share of wrong depths in the plot, whose axis is logarithmic."""


@dataclass(frozen=True)
class StereoBench(Settings):
    """Settings of `d2 bench stereo`."""

    rigs: tuple[str, ...] = ()
    """Rendered: synthetic2, synthetic3, synthetic4. From --data: studio, art, laundry, motorcycle, teddy. All that are
    available if not given."""
    data: Path | None = None
    """Folder with the recordings studio/ and middlebury/."""
    makers: tuple[str, ...] = ()
    """Matchers, of patchmatch, sgbm and colmap (which needs CUDA); all that run here if not given."""
    defaults_only: bool = False
    """Leave out what is varied about a matcher."""
    width: Annotated[int, Range(32, unit="pixels")] = 320
    """Width of rendered images, which are 16:9, pixels."""
    widen: Annotated[float, Range(1)] = 1.0
    """Make the depth range too wide by this factor at both ends."""
    repeats: Annotated[int, Range(1)] = 1
    """Matchings per row; times are medians, CPU seconds."""
    threads: AtATime = 1
    """CPU threads."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where PatchMatch runs. Times are CPU seconds either way; rows of a GPU also have wall seconds."""
    output: Path = Path("bench-stereo")
    """Folder of the results."""


def run(settings: StereoBench) -> str:
    """Measure; the table, and where rows, table and plot lie."""
    _set_threads(settings.threads)
    rows = bench_stereo(
        settings.output,
        rigs=settings.rigs or (*RENDERED, *(FROM_DISK if settings.data else ())),
        makers=settings.makers,
        defaults_only=settings.defaults_only,
        data=settings.data,
        width=settings.width,
        widen=settings.widen,
        repeats=settings.repeats,
        device=settings.device,
        command=command_line("bench stereo", settings),
    )
    return f"{table(rows)}\nstereo.jsonl (rows), stereo.md (this table) and stereo.svg (plot) are in {settings.output}"


def bench_stereo(
    output: Path,
    *,
    rigs: Sequence[str] = RENDERED,
    makers: Sequence[str] = (),
    defaults_only: bool = False,
    data: Path | None = None,
    width: int = 320,
    widen: float = 1.0,
    repeats: int = 1,
    device: Literal["cpu", "cuda"] = "cpu",
    command: str = "",
) -> list[Row]:
    """Measure and write `stereo.jsonl`, `stereo.md` and `stereo.svg` into `output`.

    Args:
        output: folder, created where absent; its three files are replaced.
        rigs: names of `load_rigs`.
        makers: `patchmatch`, `sgbm`, and `colmap` where it runs; all where empty.
        defaults_only: leave out what is varied about a matcher.
        data: folder with the recordings `studio` and `middlebury`.
        width: of rendered images, pixels.
        widen: how many times too wide the depth range is at both ends.
        repeats: of every matching; times are medians.
        device: where PatchMatch runs.
        command: how this was started, for the captions.

    Returns:
        One row per method and rig.
    """
    chosen = [_on(method, device) for method in _chosen(makers, defaults_only)]
    loaded = [load_rigs(name, data, width) for name in rigs]
    make_folder(output)
    rows: list[Row] = []
    (output / "stereo.jsonl").unlink(missing_ok=True)
    for group in loaded:
        for method in chosen:
            row = measure(method, group, widen, repeats)
            rows.append(_row(row, device=device, widen=widen, repeats=repeats, command=command))
            append_rows(output / "stereo.jsonl", rows[-1:])
            logger.info("%s (%s) on %s is measured", method.name, method.setting, row["rig"])
    (output / "stereo.md").write_text(table(rows))
    (output / "stereo.svg").write_text(plot(rows))
    return rows


def _on(method: Method, device: Literal["cpu", "cuda"]) -> Method:
    return replace(method, settings=replace(method.settings, patchmatch_device=device))


def _row(found: dict[str, Any], **more: Any) -> Row:
    """What `measure` found, as a row of the study: error 1 - F, seconds of CPU time per view."""
    case = f"{found['rig']} at {found['width']}x{found['height']}"
    error, seconds = (None, None) if found["failed"] else (1 - found["f1"], found["cpu"])
    named = ("method", "setting", "failed")
    details = {name: value for name, value in found.items() if name not in named}
    arguments = {name: found[name] for name in named}
    return make_row("stereo", case, **arguments, error=error, seconds=seconds, **details, **more)


def _chosen(makers: Sequence[str], defaults_only: bool) -> list[Method]:
    every = methods()
    known = dict.fromkeys(method.name for method in every)
    for name in makers:
        if name not in known:
            raise unknown_name("stereo matcher", name, known)
    return [
        method
        for method in every
        if (not makers or method.name in makers) and (method.setting == "default" or not defaults_only)
    ]


def table(rows: Sequence[Row]) -> str:
    """Markdown: the mean over rigs per method and setting, then every rig."""
    caption = (
        "Completeness: share of the pixels that another view sees which have a depth after the filter. F: harmonic "
        "mean of the share of depths within 1 % of the truth and the share of co-visible pixels with such a depth. "
        f"Time is of matching alone, per view. {provenance(rows[0])}"
    )
    header = ("matcher", "setting", "completeness", "F at 1 %", "median error", "off > 5 %", "CPU s", "CPU µs/pixel")
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["setting"]), []).append(row)
    over_rigs = Table(header, tuple((*key, *_numbers(_mean(group))) for key, group in groups.items()))
    each = Table(("rig", "views", "size", *header), tuple(map(_cells, rows)))
    return "\n\n".join([caption, "Mean over rigs", markdown(over_rigs), "Every rig", markdown(each)]) + "\n"


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


def plot(rows: Sequence[Row]) -> str:
    """SVG: 1 - F, 1 - completeness and the share of wrong depths against CPU time per view; lower left is better.

    Means over the rigs are geometric; a share of 0 is drawn as 0.01 %.
    """
    errors = {
        "1 - F at 1 %": lambda row: row["error"],
        "1 - completeness": lambda row: max(1 - row["completeness"], DRAWN_SHARE),
        "share off by more than 5 %": lambda row: None if row["wrong"] is None else max(row["wrong"], DRAWN_SHARE),
    }
    panels = [
        work_precision([_with_error(row, error) for row in rows], title, title, "CPU seconds per view")
        for title, error in errors.items()
    ]
    return figure(panels, "Stereo: errors against CPU time", columns=3, size=(380, 340))


def _with_error(row: Row, error: Callable[[Row], float | None]) -> Row:
    """The row with another of its figures as its error."""
    return row if row["failed"] else {**row, "error": error(row)}


def _set_threads(count: int) -> None:
    torch.set_num_threads(count)
    try:
        import cv2
    except ImportError:
        return  # whoever needs it says so
    cv2.setNumThreads(count)

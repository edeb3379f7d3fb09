"""`d2 bench stereo`: error against run time of geometric depth, every maker and setting behind the same filter."""

from __future__ import annotations

import argparse
import logging
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from d2_plugin.errors import MissingExtra, missing_extra, unknown_name
from d2_plugin.runs.provenance import provenance
from d2_plugin.study.rows import append_rows, make_row

from .stereo_measure import Method, measure, methods
from .stereo_rigs import ARCS, MIDDLEBURY, load_rigs

logger = logging.getLogger(__name__)

RENDERED = tuple(f"synthetic{views}" for views in ARCS)
FROM_DISK = ("studio", *MIDDLEBURY)


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
    command: str = "",
) -> list[dict[str, Any]]:
    """Measure and write `stereo.jsonl`, `stereo.md` and, where matplotlib is installed, `stereo.svg` into `output`.

    Args:
        output: folder, created where absent; its three files are replaced.
        rigs: names of `load_rigs`.
        makers: `patchmatch`, `sweep`, `sgbm`, and `colmap` where it runs; all where empty.
        defaults_only: leave out what is varied about a maker.
        data: folder with the captures `studio` and `middlebury`.
        width: of rendered pictures, pixels.
        widen: how many times too wide the depth range is at both ends.
        repeats: of every matching; times are medians.
        command: how this was started, for the captions.

    Returns:
        One row per method and rig.
    """
    chosen = _chosen(makers, defaults_only)
    loaded = [load_rigs(name, data, width) for name in rigs]
    output.mkdir(parents=True, exist_ok=True)
    rows = []
    (output / "stereo.jsonl").unlink(missing_ok=True)
    for group in loaded:
        for method in chosen:
            row = measure(method, group, widen, repeats)
            rows.append(_row(row, widen=widen, repeats=repeats, command=command))
            append_rows(output / "stereo.jsonl", rows[-1:])
            logger.info("%s (%s) on %s is measured", method.name, method.setting, row["rig"])
    (output / "stereo.md").write_text(table(rows))
    try:
        plot(rows, output / "stereo.svg")
    except MissingExtra as error:
        logger.warning("no plot: %s", error)
    return rows


def _row(found: dict[str, Any], **more: Any) -> dict[str, Any]:
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
            raise unknown_name("stereo maker", name, known)
    return [
        method
        for method in every
        if (not makers or method.name in makers) and (method.setting == "default" or not defaults_only)
    ]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: the mean over rigs per method and setting, then every rig."""
    captions = [
        "Completeness: share of the pixels that another view sees which have a depth after the filter. F: harmonic "
        "mean of the share of depths within 1 % of the truth and the share of co-visible pixels with such a depth. "
        f"Time is of matching alone, per view. {provenance(rows[0])}",
        "",
    ]
    header = ["maker", "setting", "completeness", "F at 1 %", "median error", "off > 5 %", "CPU s", "CPU µs/pixel"]
    lines = ["Mean over rigs", "", _line(header), _line(["---"] * len(header))]
    groups = {(row["method"], row["setting"]): [] for row in rows}
    for row in rows:
        groups[row["method"], row["setting"]].append(row)
    lines += [_line([*key, *_numbers(_mean(group))]) for key, group in groups.items()]
    header = ["rig", "views", "size", *header]
    lines += ["", "Every rig", "", _line(header), _line(["---"] * len(header))]
    for row in rows:
        size = f"{row['width']}x{row['height']}"
        lines.append(_line([row["rig"], str(row["views"]), size, row["method"], row["setting"], *_numbers(row)]))
    return "\n".join([*captions, *lines, ""])


def _mean(group: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over rigs; a rig on which the method failed counts with completeness and F of 0 and says so."""
    worked = [row for row in group if not row["failed"]]
    mean: dict[str, Any] = {"failed": None if worked else "all"}
    for name in ("completeness", "f1"):
        mean[name] = sum(row[name] for row in worked) / len(group)
    for name in ("median", "wrong", "cpu", "microseconds_per_pixel"):
        values = [row[name] for row in worked if row[name] is not None]
        mean[name] = sum(values) / len(values) if values else None
    return mean


def _numbers(row: dict[str, Any]) -> list[str]:
    if row["failed"]:
        return ["failed", *["-"] * 5]
    forms = {"completeness": "{:.3f}", "f1": "{:.3f}", "median": "{:.5f}", "wrong": "{:.2%}", "cpu": "{:.2f}"}
    forms["microseconds_per_pixel"] = "{:.1f}"
    return ["-" if row[name] is None else form.format(row[name]) for name, form in forms.items()]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """1 - F, 1 - completeness and the share of wrong depths against CPU time, means over rigs; lower left is better.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_extra("matplotlib", "report", "the plot") from None
    figure = Figure(figsize=(13, 4.5), layout="constrained")
    panels = figure.subplots(1, 3)
    groups: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        groups.setdefault(row["method"], {}).setdefault(row["setting"], []).append(row)
    for name, settings in groups.items():
        points = [(setting, _mean(group)) for setting, group in settings.items()]
        points = [(setting, mean) for setting, mean in points if not mean["failed"] and mean["wrong"] is not None]
        times = [mean["microseconds_per_pixel"] for _, mean in points]
        errors = [[1 - mean["f1"], 1 - mean["completeness"], mean["wrong"]] for _, mean in points]
        for panel, values in zip(panels, zip(*errors)):
            panel.scatter(times, values, label=name)
            for (setting, _), x, y in zip(points, times, values):
                panel.annotate(setting, (x, y), fontsize=6, xytext=(3, 3), textcoords="offset points")
    for panel, title in zip(panels, ("1 - F at 1 %", "1 - completeness", "share off by more than 5 %")):
        panel.set(xlabel="CPU microseconds per pixel and view", ylabel=title, xscale="log")
        panel.margins(x=0.3)  # settings are written to the right of their marks
        panel.set_ylim(bottom=0)
        panel.grid(True, which="both", alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=7)
    figure.supxlabel(provenance(rows[0]), fontsize=6, wrap=True)
    figure.savefig(path, metadata={"Date": None})


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `d2 bench stereo`."""
    parser = argparse.ArgumentParser(prog="d2 bench stereo", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("bench-stereo"), help="folder of the results")
    parser.add_argument(
        "--rigs",
        nargs="+",
        metavar="RIG",
        help=f"{', '.join(RENDERED)} (rendered), {', '.join(FROM_DISK)} (in --data); default: all there are",
    )
    parser.add_argument("--data", type=Path, help="folder with the captures studio/ and middlebury/")
    parser.add_argument(
        "--makers", nargs="+", default=(), metavar="MAKER", help="patchmatch, sweep, sgbm, colmap (CUDA); default all"
    )
    parser.add_argument("--defaults-only", action="store_true", help="leave out what is varied about a maker")
    parser.add_argument("--width", type=int, default=320, help="width of rendered pictures (16:9), pixels; default 320")
    parser.add_argument("--widen", type=float, default=1.0, help="depth range too wide by this factor at both ends")
    parser.add_argument("--repeats", type=int, default=1, help="matchings per row; times are medians, CPU seconds")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; default 1")
    options = parser.parse_args(argv)
    _set_threads(options.threads)
    bench_stereo(
        options.output,
        rigs=options.rigs or (*RENDERED, *(FROM_DISK if options.data else ())),
        makers=options.makers,
        defaults_only=options.defaults_only,
        data=options.data,
        width=options.width,
        widen=options.widen,
        repeats=options.repeats,
        command=shlex.join(["d2", "bench", "stereo", *(argv if argv is not None else ())]),
    )
    logger.info("results are in %s", options.output)
    return 0


def _set_threads(count: int) -> None:
    torch.set_num_threads(count)
    try:
        import cv2
    except ImportError:
        return  # whoever needs it says so
    cv2.setNumThreads(count)

"""`d2 bench raster`: time against error of the rasterizer, beside its peers, on scenes of known size."""

from __future__ import annotations

import argparse
import logging
import math
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from d2_plugin.errors import D2Error, MissingExtra, missing_extra
from d2_plugin.runs.provenance import provenance
from d2_plugin.study.rows import append_rows, make_row

from .raster_measure import (
    THRESHOLDS,
    Case,
    error_of,
    exact,
    implementations,
    passes_of,
    peak_memory,
    threshold_errors,
    timed,
    with_thresholds,
)

logger = logging.getLogger(__name__)

SCENES = ("synth:10000", "synth:50000", "synth:200000")
SIZES = ("320x180", "640x360", "1280x720")
PASSES = ("forward", "forward+backward", "survey")


def bench_raster(
    output: Path,
    *,
    scenes: Sequence[str] = SCENES,
    sizes: Sequence[str] = SIZES,
    garden: Path | None = None,
    device: str = "cpu",
    seconds: float = 3.0,
    error_limit: int = 60_000,
    memory: bool = True,
    command: str = "",
) -> list[dict[str, Any]]:
    """Measure and write `raster.jsonl`, `raster.md` and, where matplotlib is installed, `raster.svg` into `output`.

    Args:
        output: folder, created where absent; its three files are replaced.
        scenes: `synth:N` and `garden`.
        sizes: images as WIDTHxHEIGHT in pixels.
        garden: gsplat's test_garden.npz; with it `garden` is measured too.
        device: what torch calls it.
        seconds: about how long each pass is repeated.
        error_limit: most Gaussians for which the error is measured; the truth in float64 takes minutes beyond.
        memory: whether peak memory is measured; on the CPU that takes a new process for every row.
        command: how this was started, for the captions.

    Returns:
        One row per implementation, scene and size; the file also has one per setting of the thresholds, where errors
        are measured.
    """
    output.mkdir(parents=True, exist_ok=True)
    names = [*scenes, *(["garden"] if garden and "garden" not in scenes else [])]
    cases = [Case(name, *parse_size(size), garden) for name in names for size in sizes]
    rows = []
    (output / "raster.jsonl").unlink(missing_ok=True)
    for case in cases:
        measured = _measure(case, torch.device(device), seconds, error_limit, memory, command)
        append_rows(output / "raster.jsonl", measured)
        if measured[0]["errors"]:
            found = _measure_thresholds(case, torch.device(device), seconds, command)
            append_rows(output / "raster.jsonl", found)
        rows += measured
    (output / "raster.md").write_text(table(rows))
    try:
        plot(rows, output / "raster.svg")
    except MissingExtra as error:
        logger.warning("no plot: %s", error)
    return rows


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from `WIDTHxHEIGHT`."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise D2Error(f"size '{text}' is not WIDTHxHEIGHT in pixels, e.g. 640x360")
    return int(width), int(height)


def _measure(
    case: Case, device: torch.device, seconds: float, error_limit: int, memory: bool, command: str
) -> list[dict[str, Any]]:
    scene = case.load()
    gaussians = len(scene.means)
    truth = exact(scene) if gaussians <= error_limit else None
    rows = []
    for name, render in implementations(device, gaussians).items():
        passes = passes_of(render, scene, device)
        times = timed(passes, device, seconds)
        errors = error_of(render, scene, device, truth) if truth else None
        rows.append(
            make_row(
                *("raster", f"{case.scene} at {case.width}x{case.height}", name),
                error=errors["color"]["p99.9"] if errors else None,
                seconds=times["forward+backward"]["median_ms"] / 1e3,
                command=command,
                device=device,
                scene=case.scene,
                width=case.width,
                height=case.height,
                gaussians=gaussians,
                passes=times,
                errors=errors,
                peak_mb=peak_memory(case, name, device) if memory else None,
            )
        )
        logger.info("%s, %s at %dx%d is measured", name, *case[:3])
    return rows


def _measure_thresholds(case: Case, device: torch.device, seconds: float, command: str) -> list[dict[str, Any]]:
    """What the thresholds of splatting cost in error and save in time, one row each, for `d2 report`."""
    scene, where = case.load(), f"{case.scene} at {case.width}x{case.height}"
    works = {name: passes_of(with_thresholds(name), scene, device)["forward+backward"] for name in THRESHOLDS}
    times, errors = timed(works, device, seconds), threshold_errors(scene, device)
    logger.info("thresholds on %s are measured", where)
    return [
        make_row(
            *("raster", where, "d2", name),
            error=error,
            seconds=times[name]["median_ms"] / 1e3,
            command=command,
            device=device,
            thresholds=name,
        )
        for name, error in errors.items()
    ]


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope p of time ~ size^p by least squares in logarithms, None with fewer than two sizes."""
    if len({size for size, _ in points}) < 2:
        return None
    logs = [(math.log(size), math.log(value)) for size, value in points]
    mean_x, mean_y = (sum(values) / len(logs) for values in zip(*logs))
    spread = sum((x - mean_x) ** 2 for x, _ in logs)
    return sum((x - mean_x) * (y - mean_y) for x, y in logs) / spread


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: times, memory and errors per case, then how time grows with Gaussians and with pixels."""
    lines = [_caption(rows), ""]
    header = ["implementation", "scene", "size", *(f"{kind} ms" for kind in PASSES), "CPU ms", "peak MB"]
    header += ["color p99.9", "color max", "pixels apart", "worst gradient"]
    lines += [_line(header), _line(["---"] * len(header))]
    lines += [_line(_cells(row)) for row in rows]
    lines += ["", *_scaling(rows), ""]
    return "\n".join(lines)


def _caption(rows: Sequence[dict[str, Any]]) -> str:
    return (
        "Median wall time and half the interquartile range in ms; CPU ms is the CPU time of one forward+backward over "
        "all threads; peak MB is what one forward+backward takes beyond its inputs. Error against float64: absolute "
        "for color (0..1), relative L2 for gradients; pixels apart are the share where a threshold was decided "
        f"differently, gradients are without them. {provenance(rows[0])}"
    )


def _cells(row: dict[str, Any]) -> list[str]:
    def milliseconds(kind: str) -> str:
        found = row["passes"].get(kind)
        return f"{found['median_ms']:.2f} ± {found['iqr_ms'] / 2:.2f}" if found else "-"

    cells = [row["method"], row["scene"], f"{row['width']}x{row['height']}", *map(milliseconds, PASSES)]
    cells += [f"{row['passes']['forward+backward']['cpu_ms']:.2f}"]
    cells += ["-" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}"]
    error = row["errors"]
    if not error:
        return [*cells, *["-"] * 4]
    worst = max(value["relative_l2"] for name, value in error.items() if name.startswith("grad"))
    color = error["color"]
    return [*cells, f"{color['p99.9']:.1e}", f"{color['max']:.1e}", f"{error['pixels']['apart']:.1e}", f"{worst:.1e}"]


def _scaling(rows: Sequence[dict[str, Any]]) -> list[str]:
    lines = ["Forward+backward grows as:", ""]
    for name, mine in _grouped(rows, lambda row: row["method"]):
        synthetic = [row for row in mine if row["scene"] != "garden"]
        for size, group in _grouped(synthetic, lambda row: f"{row['width']}x{row['height']}"):
            if (power := exponent([(row["gaussians"], _milliseconds(row)) for row in group])) is not None:
                lines.append(f"- {name} at {size}: N^{power:.2f}")
        for scene, group in _grouped(mine, lambda row: row["scene"]):
            if (power := exponent([(row["width"] * row["height"], _milliseconds(row)) for row in group])) is not None:
                lines.append(f"- {name}, {scene}: pixels^{power:.2f}")
    return lines


def _grouped(
    rows: Sequence[dict[str, Any]], key: Callable[[dict[str, Any]], str]
) -> list[tuple[str, list[dict[str, Any]]]]:
    return [(value, [row for row in rows if key(row) == value]) for value in dict.fromkeys(map(key, rows))]


def _milliseconds(row: dict[str, Any]) -> float:
    return row["passes"]["forward+backward"]["median_ms"]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Error against time, and time against the number of Gaussians.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_extra("matplotlib", "report", "the plot") from None
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, mine in _grouped(rows, lambda row: row["method"]):
        known = [row for row in mine if row["errors"]]
        errors = [max(row["errors"]["color"]["p99.9"], 1e-9) for row in known]
        if known:
            left.scatter([_milliseconds(row) for row in known], errors, label=name)
        synthetic = [row for row in mine if row["scene"] != "garden"]
        for size, group in _grouped(synthetic, lambda row: f"{row['width']}x{row['height']}"):
            points = sorted((row["gaussians"], _milliseconds(row)) for row in group)
            right.plot(*zip(*points), marker="o", label=f"{name}, {size}")
    if not any(row["errors"] for row in rows):
        left.text(0.5, 0.5, "error not measured", ha="center", transform=left.transAxes)
    labels = (("forward+backward, ms", "color error against float64, p99.9"), ("Gaussians", "forward+backward, ms"))
    for axes, (x, y) in zip((left, right), labels):
        axes.set(xlabel=x, ylabel=y)
        if axes.get_legend_handles_labels()[0]:
            axes.set(xscale="log", yscale="log")
            axes.grid(True, which="both", alpha=0.3)
            axes.legend(fontsize=7)
    figure.supxlabel(provenance(rows[0]), fontsize=6, wrap=True)
    figure.savefig(path, metadata={"Date": None})


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `d2 bench raster`."""
    parser = argparse.ArgumentParser(prog="d2 bench raster", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("bench-raster"), help="folder of the results")
    parser.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE", help="synth:N (N Gaussians), garden")
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="WxH", help="image sizes in pixels")
    parser.add_argument("--garden", type=Path, help="gsplat's test_garden.npz; adds the scene 'garden'")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--seconds", type=float, default=3.0, help="about how long each pass is repeated, seconds")
    parser.add_argument("--threads", type=int, help="CPU threads; default: torch's")
    parser.add_argument(
        "--error-limit", type=int, default=60_000, help="most Gaussians for which the error is measured (slow beyond)"
    )
    parser.add_argument("--no-memory", action="store_true", help="do not measure peak memory (a new process per row)")
    options = parser.parse_args(argv)
    if options.threads:
        torch.set_num_threads(options.threads)
    command = shlex.join(["d2", "bench", "raster", *(argv if argv is not None else ())])
    bench_raster(
        options.output,
        scenes=options.scenes,
        sizes=options.sizes,
        garden=options.garden,
        device=options.device,
        seconds=options.seconds,
        error_limit=options.error_limit,
        memory=not options.no_memory,
        command=command,
    )
    logger.info("results are in %s", options.output)
    return 0

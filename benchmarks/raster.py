"""`d2 bench raster`: time against error of the rasterizer, beside its peers, on scenes of known size."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

from benchmarks.raster_measure import (
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
from d2_plugin.durable import make_folder
from d2_plugin.errors import D2Error
from d2_plugin.recordings.checks.memory import BYTES_PER_PIXEL, check_bytes
from d2_plugin.runs.command_line import command_line
from d2_plugin.runs.growth import power
from d2_plugin.runs.markup import Table, markdown
from d2_plugin.runs.provenance import provenance
from d2_plugin.runs.report.precision import raster_plot
from d2_plugin.runs.report.svg import figure
from d2_plugin.runs.report.work_precision import colors_of, growth
from d2_plugin.runs.rows import Row, append_rows, make_row
from d2_plugin.settings import AtATime, Count, NotNegative, Settings

logger = logging.getLogger(__name__)

Key = TypeVar("Key")

PASSES = ("forward", "forward+backward", "survey")


@dataclass(frozen=True)
class RasterBench(Settings):
    """Settings of `d2 bench raster`."""

    scenes: tuple[str, ...] = ("synth:10000", "synth:50000", "synth:200000")
    """What is drawn: synth:N for N synthetic Gaussians, or garden."""
    sizes: tuple[str, ...] = ("320x180", "640x360", "1280x720")
    """Image sizes as WIDTHxHEIGHT in pixels."""
    garden: Path | None = None
    """Path of gsplat's test_garden.npz, which adds the scene garden."""
    device: str = "cpu"
    """Where it is drawn: cpu or cuda."""
    seconds: NotNegative = 3.0
    """About how long each pass is repeated, seconds."""
    threads: AtATime | None = None
    """CPU threads; if not given, torch chooses."""
    error_limit: Count = 60_000
    """Most Gaussians for which the error is measured; with more of them the truth in float64 takes minutes."""
    no_memory: bool = False
    """Leave out peak memory, which takes a new process for every row on the CPU."""
    output: Path = Path("bench-raster")
    """Folder of the results."""


def run(settings: RasterBench) -> str:
    """Measure; the table, and where rows, table and plot lie."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    rows = bench_raster(
        settings.output,
        scenes=settings.scenes,
        sizes=settings.sizes,
        garden=settings.garden,
        device=settings.device,
        seconds=settings.seconds,
        error_limit=settings.error_limit,
        memory=not settings.no_memory,
        command=command_line("bench raster", settings),
    )
    return f"{table(rows)}\nraster.jsonl (rows), raster.md (this table) and raster.svg (plot) are in {settings.output}"


def bench_raster(
    output: Path,
    *,
    scenes: Sequence[str] = RasterBench.scenes,
    sizes: Sequence[str] = RasterBench.sizes,
    garden: Path | None = None,
    device: str = "cpu",
    seconds: float = RasterBench.seconds,
    error_limit: int = RasterBench.error_limit,
    memory: bool = True,
    command: str = "",
) -> list[Row]:
    """Measure and write `raster.jsonl`, `raster.md` and `raster.svg` into `output`.

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
    make_folder(output)
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
    (output / "raster.svg").write_text(plot(rows))
    return rows


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from `WIDTHxHEIGHT`."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if found is None:
        raise D2Error(f"size '{text[:40]}' is not WIDTHxHEIGHT in pixels of at most five digits, e.g. 640x360")
    width, height = int(found[1]), int(found[2])
    check_bytes(width * height * BYTES_PER_PIXEL, f"images of {width}x{height} pixels", "measure smaller ones")
    return width, height


def _measure(
    case: Case, device: torch.device, seconds: float, error_limit: int, memory: bool, command: str
) -> list[Row]:
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


def _measure_thresholds(case: Case, device: torch.device, seconds: float, command: str) -> list[Row]:
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


def table(rows: Sequence[Row]) -> str:
    """Markdown: times, memory and errors per case, then how time grows with Gaussians and with pixels."""
    header = ("implementation", "scene", "size", *(f"{kind} ms" for kind in PASSES), "CPU ms", "peak MB")
    header += ("color p99.9", "color max", "pixels apart", "worst gradient")
    parts = [_caption(rows), markdown(Table(header, tuple(map(_cells, rows))))]
    grown = [f"- {name}: {law}" for name, law in _growth(rows)]
    return "\n\n".join([*parts, "Forward+backward grows as:", "\n".join(grown)]) + "\n"


def _caption(rows: Sequence[Row]) -> str:
    return (
        "Median wall time and half the interquartile range in ms; CPU ms is the CPU time of one forward+backward over "
        "all threads; peak MB is what one forward+backward takes beyond its inputs. Error against float64: absolute "
        "for color (0..1), relative L2 for gradients; pixels apart are the share where a threshold was decided "
        f"differently, gradients are without them. {provenance(rows[0])}"
    )


def _cells(row: Row) -> tuple[str, ...]:
    def milliseconds(kind: str) -> str:
        found = row["passes"].get(kind)
        return f"{found['median_ms']:.2f} ± {found['iqr_ms'] / 2:.2f}" if found else "-"

    cpu = f"{row['passes']['forward+backward']['cpu_ms']:.2f}"
    peak = "-" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}"
    size = f"{row['width']}x{row['height']}"
    return (row["method"], row["scene"], size, *map(milliseconds, PASSES), cpu, peak, *_error_cells(row["errors"]))


def _error_cells(errors: Mapping[str, Mapping[str, float]] | None) -> tuple[str, ...]:
    if not errors:
        return ("-",) * 4
    worst = max(value["relative_l2"] for name, value in errors.items() if name.startswith("grad"))
    color = errors["color"]
    return tuple(f"{value:.1e}" for value in (color["p99.9"], color["max"], errors["pixels"]["apart"], worst))


def _growth(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """What grows, and as which power of the number of Gaussians or of pixels."""
    laws = [(name, power(line, "N")) for name, line in _by_gaussians(rows).items()]
    for (name, scene), group in _grouped(rows, lambda row: (row["method"], row["scene"])):
        line = [(row["width"] * row["height"], _milliseconds(row)) for row in group]
        laws.append((f"{name}, {scene}", power(line, "pixels")))
    return [(name, law) for name, law in laws if law is not None]


def _by_gaussians(rows: Sequence[Row]) -> Mapping[str, list[tuple[float, float]]]:
    """Milliseconds over the number of synthetic Gaussians, per implementation and image size."""
    synthetic = [row for row in rows if row["scene"] != "garden"]
    groups = _grouped(synthetic, lambda row: f"{row['method']} at {row['width']}x{row['height']}")
    return {name: sorted((row["gaussians"], _milliseconds(row)) for row in group) for name, group in groups}


def _grouped(rows: Sequence[Row], key: Callable[[Row], Key]) -> list[tuple[Key, list[Row]]]:
    return [(value, [row for row in rows if key(row) == value]) for value in dict.fromkeys(map(key, rows))]


def _milliseconds(row: Row) -> float:
    return row["passes"]["forward+backward"]["median_ms"]


def plot(rows: Sequence[Row]) -> str:
    """SVG: error against time where errors were measured, and time against the number of Gaussians."""
    lines, colors = _by_gaussians(rows), colors_of(rows)
    panels = (raster_plot(rows), growth("Growth", "Gaussians", "forward+backward, ms", lines, len(colors)))
    return figure(panels, "Rasterizer: error against time, and time against Gaussians", columns=2, size=(480, 340))

"""`python -m benchmarks raster`: time against error of the rasterizer, beside its peers, on scenes of known size."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.raster_measure import (
    Case,
    error_of,
    exact,
    implementations,
    passes_of,
    peak_memory,
    timed,
)
from benchmarks.rows import begin_rows, told
from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table
from d2_plugin.settings import AtATime, Count, NotNegative, Settings

logger = logging.getLogger(__name__)

PASSES = ("forward", "forward+backward", "survey")


@dataclass(frozen=True)
class RasterBench(Settings):
    """Settings of `python -m benchmarks raster`."""

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
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


def run(settings: RasterBench) -> str:
    """Measure and add the rows, one per implementation, scene and size; the table, and where the rows lie."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    names = [*settings.scenes, *(["garden"] if settings.garden and "garden" not in settings.scenes else [])]
    cases = [Case(name, *parse_size(size), settings.garden) for name in names for size in settings.sizes]
    begin_rows(settings.output)
    command, rows = command_line("python -m benchmarks raster", settings), list[Row]()
    for case in cases:
        measured = _measure(case, settings, command)
        append_rows(settings.output, measured)
        rows += measured
    return told(tables(rows), settings.output, CAPTION)


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from `WIDTHxHEIGHT`."""
    found = re.fullmatch(r"([1-9][0-9]{0,3})x([1-9][0-9]{0,3})", text)
    if found is None:
        raise D2Error(f"size '{text[:40]}' is not WIDTHxHEIGHT in pixels of at most four digits, e.g. 640x360")
    return int(found[1]), int(found[2])


def _measure(case: Case, settings: RasterBench, command: str) -> list[Row]:
    scene, device = case.load(), torch.device(settings.device)
    gaussians = len(scene.means)
    truth = exact(scene, device) if gaussians <= settings.error_limit else None
    rows = []
    for name, render in implementations(device, gaussians).items():
        passes = passes_of(render, scene, device)
        times = timed(passes, device, settings.seconds)
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
                peak_mb=None if settings.no_memory else peak_memory(case, name, device),
            )
        )
        logger.info("%s, %s at %dx%d is measured", name, *case[:3])
    return rows


CAPTION = (
    "Median wall time and half the interquartile range in ms; CPU ms is the CPU time of one forward+backward over "
    "all threads; peak MB is what one forward+backward takes beyond its inputs. Error against float64: absolute "
    "for color (0..1), relative L2 for gradients; pixels apart are the share where a threshold was decided "
    "differently, gradients are without them."
)


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """Times, memory and errors per case."""
    header = ("implementation", "scene", "size", *(f"{kind} ms" for kind in PASSES), "CPU ms", "peak MB")
    header += ("color p99.9", "color max", "pixels apart", "worst gradient")
    return [("Every scene and size", Table(header, tuple(map(_cells, rows))))]


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

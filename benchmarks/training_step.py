"""`python -m benchmarks training-step`: what one optimizer step costs beside the rasterizer's own forward and backward.

Everything is synthetic and made here: N Gaussians of the native backbone, all of them seen, four cameras, images and
depth.
Three works run in turn in one process, so that each sees the same machine: the rasterizer alone on those Gaussians, a
bare step, and a step with the depth loss at every one. Their ratios are what the figures are for.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch

from benchmarks.memory import in_fresh_process, peak_resident
from benchmarks.raster import parse_size
from benchmarks.raster_measure import timed
from benchmarks.rows import begin_rows
from benchmarks.training_step_scene import RASTER, StepScene, look_at_all, works_of
from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.tables import Table, markdown
from d2_plugin.settings import AtATime, Range, Settings

BARE, GUIDED = "step", "step with D2"


@dataclass(frozen=True)
class TrainingStepBench(Settings):
    """Settings of `python -m benchmarks training-step`."""

    gaussians: tuple[Annotated[int, Range(1, 10_000_000)], ...] = (4000,)
    """How many Gaussians the model has."""
    sizes: tuple[str, ...] = ("320x180",)
    """Image sizes as WIDTHxHEIGHT in pixels."""
    frames: tuple[Annotated[int, Range(1, 10_000)], ...] = (20,)
    """Lengths of the recording of four cameras; all images are looked at once before memory is measured."""
    seconds: Annotated[float, Range(0)] = 6.0
    """About how long each of the three works is repeated, seconds."""
    threads: AtATime = 2
    """CPU threads."""
    no_memory: bool = False
    """Leave out peak memory, which takes a new process for every row."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


class StepCase(NamedTuple):
    """What is trained."""

    gaussians: int
    width: int
    height: int
    frames: int

    def scene(self) -> StepScene:
        """Model, images and prior."""
        return StepScene.make(*self)


def run(settings: TrainingStepBench) -> str:
    """Measure and add the rows; the table, and where the rows lie."""
    torch.set_num_threads(settings.threads)
    begin_rows(settings.output)
    cases = [
        StepCase(count, width, height, frames)
        for count in settings.gaussians
        for width, height in map(parse_size, settings.sizes)
        for frames in settings.frames
    ]
    command = command_line("python -m benchmarks training-step", settings)
    rows = [row for case in cases for row in measure(case, settings.seconds, not settings.no_memory, command)]
    append_rows(settings.output, rows)
    text = f"{markdown(table(rows))}\n\nD2's share of a step: {share(rows):.1%}"
    return f"{text}\n\nrows are in {settings.output}"


def measure(case: StepCase, seconds: float, memory: bool = True, command: str = "") -> list[Row]:
    """One row for each work on one case: wall and CPU time, the ratio of CPU times to the rasterizer's, peak memory."""
    works = works_of(case.scene())
    times = timed(works, torch.device("cpu"), seconds)
    peaks = {name: in_fresh_process(_steps, case, name).result if memory else None for name in works}
    if times[RASTER]["cpu_ms"] <= 0:
        raise D2Error("the rasterizer took no CPU time that can be measured: give more --gaussians or larger --sizes")
    where = f"{case.gaussians} Gaussians at {case.width}x{case.height}, {case.frames} frames"
    return [
        make_row(
            *("step", where, name),
            error=None,
            seconds=times[name]["median_ms"] / 1e3,
            command=command,
            **case._asdict(),
            passes={"step": times[name]},
            ratio=times[name]["cpu_ms"] / times[RASTER]["cpu_ms"],
            peak_mb=peaks[name],
        )
        for name in works
    ]


def _steps(case: StepCase, name: str) -> float:
    """Peak memory, MB, of making the scene, looking at all its images, and three of the works."""
    works_of(StepCase(100, 64, 48, 1).scene())[name]()  # libraries and thread stacks are not the step's memory

    def work() -> None:
        scene = case.scene()
        look_at_all(scene)
        works: dict[str, Callable[[], Any]] = works_of(scene)
        for _ in range(3):
            works[name]()

    return peak_resident(work).peak_mb


def table(rows: Sequence[Row]) -> Table:
    """One line per work."""
    header = ("case", "work", "CPU ms", "wall ms", "CPU over the rasterizer's", "peak MB")
    cells = tuple(
        (
            *(row["case"], row["method"]),
            f"{row['passes']['step']['cpu_ms']:.2f}",
            f"{row['passes']['step']['median_ms']:.2f} ± {row['passes']['step']['iqr_ms'] / 2:.2f}",
            f"{row['ratio']:.2f}",
            "-" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}",
        )
        for row in rows
    )
    return Table(header, cells)


def share(rows: Sequence[Row]) -> float:
    """The median over cases of what D2 adds to the CPU time of a bare step, as a share of that."""
    bare = {row["case"]: row["ratio"] for row in rows if row["method"] == BARE}
    return statistics.median(row["ratio"] / bare[row["case"]] - 1 for row in rows if row["method"] == GUIDED)

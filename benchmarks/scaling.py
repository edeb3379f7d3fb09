"""`python -m benchmarks scaling`: how the time of priors and the memory of training grow with the number of frames.

The recording is synthetic, written to disk and read back frame by frame as others are. Priors and training run
in processes of their own. Training keeps decoded images up to a bound (320 MiB) and re-reads the others.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.memory import in_fresh_process
from benchmarks.rows import begin_rows, told
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import split, synthetic_recording
from d2_plugin.runs.rows import Row, append_rows, command_line, make_row
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.tables import Table
from d2_plugin.settings import Range, Settings


@dataclass(frozen=True)
class ScalingBench(Settings):
    """Settings of `python -m benchmarks scaling`."""

    frames: tuple[Annotated[int, Range(1)], ...] = (5, 20, 80)
    """Lengths of the recording, frames."""
    width: Annotated[int, Range(32, unit="pixels")] = 160
    """Width of the images, which are 16:9, pixels."""
    iterations: Annotated[int, Range(1, unit="steps")] = 150
    """Optimizer steps of each training."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


def run(settings: ScalingBench) -> str:
    """Measure and add the rows, of priors and of training with all hooks for each length; the table, and their place.

    Two cameras train and one is held out.
    """
    begin_rows(settings.output)
    width, iterations, rows = settings.width, settings.iterations, []
    command = command_line("python -m benchmarks scaling", settings)
    with tempfile.TemporaryDirectory() as folder:
        for count in settings.frames:
            place = Path(folder) / str(count)
            recording = synthetic_recording(2, frames=count, width=width, height=width * 9 // 16, arc_degrees=20)
            save_recording(recording, place / "recording")
            chosen = RunSettings(str(place / "recording"), tuple(split(recording)[0]), iterations=iterations)
            for part, work in (("priors", _priors), ("training", _training)):
                result, peak = in_fresh_process(work, chosen, place / "run")
                about = {"frames": count, "peak_mb": peak, "width": width, "iterations": iterations, **result}
                case = f"synthetic, {count} frames"
                rows.append(make_row("scaling", case, part, f"{count} frames", error=None, command=command, **about))
    append_rows(settings.output, rows)
    return told(tables(rows), settings.output)


def _priors(settings: RunSettings, folder: Path) -> dict[str, Any]:
    start = time.perf_counter()
    Run(settings, folder).prepare()
    return {"seconds": time.perf_counter() - start}


def _training(settings: RunSettings, folder: Path) -> dict[str, Any]:
    run = Run(settings, folder)
    run.train()
    return {"seconds": run.seconds["train"]}


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """One line per part and cost: its value for each length, and the power of the number of frames it grows as."""
    lengths, lines = sorted({row["frames"] for row in rows}), []
    for part in ("priors", "training"):
        for measure, title in (("seconds", "seconds"), ("peak_mb", "peak MB")):
            places = [(row["frames"], row[measure]) for row in rows if row["method"] == part and row[measure]]
            grown = exponent(places)
            values = (f"{dict(places)[length]:.1f}" if length in dict(places) else "-" for length in lengths)
            lines.append((part, title, *values, "-" if grown is None else f"frames^{round(grown, 2) + 0.0:.2f}"))
    header = ("part", "of", *(f"{length:g} frames" for length in lengths), "grows as")
    return [("Measured", Table(header, tuple(lines)))]


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope p of cost ~ size^p by least squares in logarithms, from (size, cost); None with fewer than two sizes."""
    if len({size for size, _ in points}) < 2:
        return None
    sizes, costs = np.log(points).T
    return float(np.polyfit(sizes, costs, 1)[0])

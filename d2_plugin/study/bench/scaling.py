"""`d2 bench scaling`: how the time of priors and the memory of training grow with the number of frames.

The capture is synthetic, written to disk and read back frame by frame as a recording would be. Priors and training run
in processes of their own. Training keeps decoded pictures up to a bound (1 GiB) and re-reads the others.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from d2_plugin.captures.export.folder import save_capture
from d2_plugin.captures.synthetic.room import split, synthetic_capture
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.study.rows import Row, append_rows, make_row

from .memory import in_fresh_process
from .raster import exponent

FRAMES = (5, 20, 80)


def bench_scaling(
    frames: Sequence[int] = FRAMES, width: int = 160, iterations: int = 150, command: str = ""
) -> list[Row]:
    """Two rows per number of frames: building priors (time and memory), and training with all hooks.

    Args:
        frames: lengths of the recording, at two training cameras and one held out.
        width: of the pictures (16:9), pixels.
        iterations: optimizer steps of each training.
        command: how this was started.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for count in frames:
            place = Path(folder) / str(count)
            capture = synthetic_capture(2, frames=count, width=width, height=width * 9 // 16, arc_degrees=20)
            save_capture(capture, place / "capture")
            settings = RunSettings(str(place / "capture"), tuple(split(capture)[0]), iterations=iterations)
            for part, work in (("priors", _priors), ("training", _training)):
                result, peak = in_fresh_process(work, settings, place / "run")
                about = {"frames": count, "peak_mb": peak, "width": width, "iterations": iterations, **result}
                case = f"synthetic, {count} frames"
                rows.append(make_row("scaling", case, part, f"{count} frames", error=None, command=command, **about))
    return rows


def _priors(settings: RunSettings, folder: Path) -> dict[str, Any]:
    start = time.perf_counter()
    Run(settings, folder).prepare()
    return {"seconds": time.perf_counter() - start}


def _training(settings: RunSettings, folder: Path) -> dict[str, Any]:
    run = Run(settings, folder)
    run.train()
    return {"seconds": run.seconds["train"]}


def growth(rows: Sequence[Row], part: str, measure: str) -> float | None:
    """Exponent p of `measure` ("seconds", "peak_mb") ~ frames^p; None with fewer than two lengths."""
    return exponent([(row["frames"], row[measure]) for row in rows if row["method"] == part and row[measure]])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `d2 bench scaling`."""
    parser = argparse.ArgumentParser(prog="d2 bench scaling", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs.jsonl"), help="rows are added to it; runs.jsonl")
    parser.add_argument("--frames", nargs="+", type=int, default=FRAMES, help="lengths of the recording; 5 20 80")
    parser.add_argument("--width", type=int, default=160, help="of the pictures, 16:9, pixels; 160")
    parser.add_argument("--iterations", type=int, default=150, help="optimizer steps of each training; 150")
    options = parser.parse_args(arguments)
    command = shlex.join(["d2", "bench", "scaling", *(arguments or ())])
    rows = bench_scaling(options.frames, options.width, options.iterations, command)
    append_rows(options.output, rows)
    for part in ("priors", "training"):
        for measure in ("seconds", "peak_mb"):
            found = [f"{row['frames']}: {row[measure]:.1f}" for row in rows if row["method"] == part]
            power = growth(rows, part, measure)
            text = "" if power is None else f"  grows as frames^{power:.2f}"
            sys.stdout.write(f"{part:9} {measure:8} {', '.join(found)}{text}\n")
    return 0

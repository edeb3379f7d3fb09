"""What benchmarks of many short runs share: their settings, and measuring what is missing."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from benchmarks.rows import told
from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import Table
from d2_plugin.runs.training import measured
from d2_plugin.runs.training.measured import Work
from d2_plugin.settings import AtATime, Count, Downscale, Positional, Settings


@dataclass(frozen=True)
class ShortRuns(Settings):
    """Settings of every such benchmark."""

    recordings: Annotated[tuple[str, ...], Positional()] = ()
    """Recordings with their cameras, as PATH@TRAIN+TRAIN or PATH@TRAIN+TRAIN@SCORE+SCORE."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames, in every recording; all if not given."""
    downscale: Downscale = 1
    """Make images this many times smaller along each side."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth; the recordings' own maps if not given."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns."""
    jobs: AtATime = os.cpu_count() or 1
    """Runs at a time, one thread each."""


def measure_missing(
    name: str,
    settings: ShortRuns,
    path: Path,
    works_of: Callable[[str], Iterable[Work]],
    tables: Callable[[Sequence[Row]], list[tuple[str, Table]]],
) -> str:
    """Measure what has no row in the file yet; the tables of all its rows, and where they lie.

    Args:
        works_of: every run of one of the recordings; points and priors are made there.
    """
    if not settings.recordings:
        raise D2Error(f"the benchmark {name} needs a recording with its cameras: write PATH@00+02+05+07")
    works = [work for text in settings.recordings for work in works_of(text)]
    return told(tables(measured.measure_missing(f"bench {name}", works, path, settings.jobs)), path)

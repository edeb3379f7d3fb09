"""`python -m benchmarks trainers FOLDER`: the official trainers, unedited: bare, with D2 without hooks, and with all.

FOLDER holds one checkout per repository, named as its repository is. Each runs its own script for some hundred
iterations on recordings that `d2 export-recording` wrote in its layout, and is judged by its own report of held-out
cameras. A run without hooks has to end with the bare run's numbers, bit for bit. What is absent is left out by name.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.trainers.page import read_rows, replaced, table
from benchmarks.trainers.prepare import Source, prepare
from benchmarks.trainers.trial_run import METHODS, trial_row
from benchmarks.trainers.trials import TRIALS
from d2_plugin.durable import append
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.reading import json_text, read_text
from d2_plugin.runs.rows import Row, circumstances, command_line
from d2_plugin.settings import Positional, Range, Seed, Settings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainersBench(Settings):
    """Settings of `python -m benchmarks trainers`."""

    checkouts: Annotated[Path | None, Positional()] = None
    """Folder with one checkout per repository; if left out, nothing runs and the tables are made of the rows."""
    recordings: tuple[Path, ...] = ()
    """Recordings with cameras 00 to 07, of which 00 02 05 07 are trained on."""
    only: tuple[str, ...] = ()
    """Repositories as the launcher names them; all if left out."""
    methods: tuple[str, ...] = METHODS[:3]
    """Which runs of each: bare, no hooks, attached, with motion, with parallax."""
    iterations: Annotated[int, Range(10, unit="iterations")] = 300
    """Length of each run."""
    own_schedules: bool = False
    """Leave what counts iterations (densification, learning rates) as each script has it, not shortened."""
    seeds: tuple[Seed, ...] = (0,)
    """Added to every seed that a script sets; 0 is the script as it is. A claim needs three."""
    frames: Annotated[int, Range(2)] = 9
    """Frames of each recording that are trained on, from the first."""
    hold_out_instants: Annotated[int, Range(0, unit="instants")] = 0
    """Train every so-manieth instant alone and score what moves at those between as well; 0 or 1 trains all."""
    downscale: Annotated[int, Range(1)] = 2
    """Make images this many times smaller along each side."""
    work: Path = Path("trainers")
    """Folder of exports, priors and runs; what is there already is used again."""
    output: Path = Path("trainers.jsonl")
    """File that the rows are added to."""
    page: Path | None = None
    """Markdown whose tables between `<!-- rows -->` and `<!-- end -->` are made anew from all rows of that file."""


def run(settings: TrainersBench) -> str:
    """Run what is there, add the rows, and make the tables."""
    refuse_unknown("repository", settings.only, TRIALS)
    refuse_unknown("method", settings.methods, METHODS)
    absent = []
    for name in settings.only or TRIALS:
        if settings.checkouts is None:
            break
        if not (settings.checkouts / TRIALS[name].folder).is_dir():
            absent.append(f"{name}: no folder {TRIALS[name].folder}, left out")
            continue
        for row in rows_of(name, settings):
            append(settings.output, json_text(row, "the row") + "\n")
            log.info("%s", _sentence(row))
    tables = table(read_rows(settings.output))
    if settings.page is not None:
        text = read_text(settings.page, "give a Markdown file, with its two marks")
        settings.page.write_text(replaced(text, tables, str(settings.page)), encoding="utf-8")
    return "\n".join([tables, *absent, f"rows are in {settings.output}"])


def rows_of(name: str, settings: TrainersBench) -> Iterator[Row]:
    """One repository: a row for each recording, seed and method, as soon as it is there."""
    assert settings.checkouts is not None
    trial = TRIALS[name]
    if settings.hold_out_instants > 1 and trial.clock is None:
        able = ", ".join(name for name, known in TRIALS.items() if known.clock is not None)
        raise D2Error(f"{name} is not scored between instants: give --only {able}, or train all instants")
    if not settings.recordings:
        raise D2Error("no recording to train on: give --recordings, each with cameras 00 to 07")
    command = command_line("python -m benchmarks trainers", settings)
    for recording in settings.recordings:
        source = Source(recording.resolve(), settings.frames, settings.downscale, max(settings.hold_out_instants, 1))
        prepared = prepare(source, trial, settings.work)
        for seed in settings.seeds:
            for method in settings.methods:
                folder = settings.work / "runs" / f"{name}-{recording.name}-{method.replace(' ', '-')}-{seed}"
                checkout = settings.checkouts / trial.folder
                row = trial_row(
                    *(name, trial, checkout, prepared, folder, method, settings.iterations, seed),
                    own_schedules=settings.own_schedules,
                )
                yield row | circumstances() | {"command": command}


def _sentence(row: Row) -> str:
    what = f"{row['repository']} on {row['recording']}, {row['method']}, seed {row['seed']}"
    return f"{what}: {row['failed'] or {int(k): round(v, 2) for k, v in row['psnr'].items()}}"

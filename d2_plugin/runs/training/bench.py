"""`d2 bench training`: backbone, rivals and D² at the same CPU time, on any number of recordings and seeds.

Each recording is written with the cameras that train, and those that score where not all others do:
PATH@00+02+05+07@01+03+04+06. Every run of one recording has the same starting points, depth inputs and settings,
and trains on one thread; its time is CPU time, which other work on the machine hardly changes. With `--seconds`, the
number of steps that a method trains in that time is found by trying, with the first seed. Rows are written as runs
finish, and the same command continues where it was stopped. `d2 report` draws them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.rivals.table import RIVALS
from d2_plugin.errors import D2Error
from d2_plugin.progress import progress_bar
from d2_plugin.reading import read_toml
from d2_plugin.runs.ablation.job import Job
from d2_plugin.runs.ablation.presets import Preset, rows_named
from d2_plugin.runs.command_line import command_line
from d2_plugin.runs.rows import Row, append_rows, read_rows
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.shared import Shared, monocular_seconds, share
from d2_plugin.runs.training.budget import TRIES, Timed, fits, nearest, next_steps
from d2_plugin.runs.training.cases import Case, case_of
from d2_plugin.runs.training.measured import TRY, Work
from d2_plugin.runs.training.spread import Line, follow, workers
from d2_plugin.settings import AtATime, AtLeastOne, Count, Positional, Positive, Range, Seed, Settings


@dataclass(frozen=True)
class TrainingBench(Settings):
    """Settings of `d2 bench training`."""

    recordings: Annotated[tuple[str, ...], Positional()] = ()
    """Recordings with their cameras, as PATH@TRAIN+TRAIN or PATH@TRAIN+TRAIN@SCORE+SCORE."""
    methods: tuple[str, ...] = ("rivals",)
    """Rows or tables of `d2 ablate`; `rivals` stands for the backbone, all rivals and D²."""
    seconds: tuple[Positive, ...] = ()
    """CPU seconds of training to compare at; 10, 30 and 100 if neither these nor steps are given."""
    steps: tuple[Annotated[int, Range(1, unit="steps")], ...] = ()
    """Numbers of steps to compare at."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds; a claim needs three."""
    backbone: str = "yang4d"
    """Name of a registered backbone."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames, in every recording; all if not given."""
    downscale: AtLeastOne = 1
    """Make images this many times smaller along each side."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth; the recordings' own maps if not given."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns."""
    config: Path | None = None
    """TOML file with tables of settings over the defaults, for every method."""
    label: str = ""
    """Stands behind the names of the methods, to tell settings of your own from the defaults."""
    jobs: AtATime = os.cpu_count() or 1
    """Runs at a time on this machine, one thread each."""
    scheduler: str | None = None
    """Address of a dask cluster to run on, as tcp://host:8786; its workers see the same files."""
    output: Path = Path("training")
    """Folder of priors, runs and training.jsonl."""


def run(settings: TrainingBench) -> str:
    """Measure what is missing; where the rows lie."""
    if not settings.recordings:
        raise D2Error("d2 bench training needs a recording with its cameras: write PATH@00+02+05+07")
    path = settings.output / "training.jsonl"
    known = read_rows([path]) if path.is_file() else []
    lines = [line for text in settings.recordings for line in _lines(settings, text, known)]
    with progress_bar("bench training", len(lines) * len(settings.seeds) * len(_targets(settings))) as bar:
        done: list[Row] = []

        def write(row: Row) -> None:
            append_rows(path, [row])
            done.extend([row] if row["target"] != TRY else [])  # a run that finds a length is beside the count
            bar.update(len(done), f"{row['case']}: {row['method']}, {row['setting']}")

        with workers(settings.jobs, settings.scheduler) as submit:
            follow(lines, submit, write)
    return f"rows are in {path}; `d2 report {path}` draws them"


Target = tuple[Literal["seconds", "steps"], float]


def _targets(settings: TrainingBench) -> list[Target]:
    """What the methods are compared at, shortest first: what was tried for one helps the next."""
    seconds = settings.seconds or (() if settings.steps else (10.0, 30.0, 100.0))
    return [*(("steps", float(n)) for n in sorted(settings.steps)), *(("seconds", s) for s in sorted(seconds))]


def _lines(settings: TrainingBench, text: str, known: Sequence[Row]) -> Iterator[Line]:
    """One line per method of a case; points and prior are made here, before anything is measured."""
    shown = ("backbone", "frames", "downscale", "mono_onnx", "mono_kind")
    base = RunSettings("", (), **{n: getattr(settings, n) for n in shown}, overrides=_tables(settings.config))
    case, presets = case_of(text, base), rows_named(settings.methods)
    for preset in presets:
        if "variant" in preset.overrides.get("priors", {}):
            raise D2Error(f"'{preset.name}' has a prior of its own, and here all methods share one: use `d2 ablate`")
    folder = settings.output.absolute() / case.slug
    cluster = None if settings.scheduler is None else {"scheduler": settings.scheduler}
    shared = share(case.settings, folder, cluster)
    for preset in presets:
        yield _line(settings, case, shared, preset, known)


def _line(settings: TrainingBench, case: Case, shared: Shared, preset: Preset, known: Sequence[Row]) -> Line:
    """All targets of one method: the length of a run is tried with the first seed, then the other seeds follow."""
    template = _Template(settings, case, shared, preset)
    found = {(row["fingerprint"], row["target"]): row for row in known if row["kind"] == "quality"}
    tried: list[Timed] = [
        (row["iterations"], row["seconds"])
        for row in found.values()
        if _same(row, case) and row["method"] == template.method and row["seconds"]
    ]

    def missing(works: Sequence[Work]) -> list[Work]:
        return [work for work in works if work.key not in found]

    for kind, size in _targets(settings):
        target, steps = (f"{size:g} s", 0) if kind == "seconds" else (f"{size:g} steps", round(size))
        if not steps:
            steps = _settled(found, template, target) or 0
            for _ in range(TRIES if not steps else 0):
                length = next_steps(size, tried)
                if any(length == n for n, _ in tried):
                    break
                rows = yield missing([template.work(length, settings.seeds[0], TRY)])
                if any(row["failed"] for row in rows):
                    return
                tried += [(row["iterations"], row["seconds"]) for row in rows]
                if tried and fits(size, tried[-1]):
                    break
            steps = steps or nearest(size, tried)
        rows = yield missing([template.work(steps, seed, target) for seed in settings.seeds])
        if rows and all(row["failed"] for row in rows):
            return
        tried += [(row["iterations"], row["seconds"]) for row in rows if row["seconds"]]


def _settled(found: dict[tuple[str, str], Row], template: _Template, target: str) -> int | None:
    """The number of steps that an earlier call chose for this time."""
    mine = template.method, target
    same = (row for row in found.values() if _same(row, template.case) and (row["method"], row["target"]) == mine)
    return next((row["iterations"] for row in same), None)


def _same(row: Row, case: Case) -> bool:
    """Whether a row is of that case; one without cameras is of an earlier version, which did not say them."""
    cameras = list(case.settings.train_cameras)
    return row["case"] == case.name and row.get("cameras", cameras) == cameras


class _Template:
    """Makes the runs of one method on one case."""

    def __init__(self, settings: TrainingBench, case: Case, shared: Shared, preset: Preset) -> None:
        self.settings, self.case, self.shared, self.preset = settings, case, shared, preset
        self.method = f"{settings.backbone} {preset.name}" + (f", {settings.label}" if settings.label else "")
        self.command = command_line("bench training", settings, False, **_joined(settings))
        self.prior_seconds = _prior_seconds(preset, case, shared)

    def work(self, steps: int, seed: int, target: str) -> Work:
        """One run of so many steps."""
        base = self.case.settings
        run = replace(base, hooks=self.preset.hooks, seed=seed, iterations=steps, priors=str(self.shared.priors))
        run = replace(run, overrides=self.preset.merged(base.overrides))
        name = self.preset.name + (f"_{self.settings.label}".replace(" ", "_") if self.settings.label else "")
        folder = self.shared.folder / "runs" / self.settings.backbone / name / f"{steps}steps" / f"seed{seed}"
        job = Job(self.preset.name, base.backbone, seed, run, folder, self.preset.rival)
        about = {"prior_seconds": self.prior_seconds, "protocol": base.protocol}
        return Work(job, self.shared, self.case.name, self.method, self.command, target, about)


def _tables(path: Path | None) -> dict[str, Any]:
    """The tables of a --config file; none where there is no file."""
    if path is None:
        return {}
    return read_toml(path, "write TOML tables, or leave out --config")


def _prior_seconds(preset: Preset, case: Case, shared: Shared) -> float | None:
    """CPU seconds of what a method needs beforehand: nothing, monocular maps, or the full prior."""
    needs = "stereo" if preset.hooks else "points" if preset.rival is None else RIVALS[preset.rival].needs
    if needs == "mono":
        return monocular_seconds(case.settings)
    return 0.0 if needs == "points" else shared.cpu_seconds if shared.cpu_seconds is not None else shared.seconds


def _joined(settings: TrainingBench) -> dict[str, Any]:
    """The values of a flag are joined by commas, where recordings stand apart."""
    many = {name: getattr(settings, name) or () for name in ("methods", "seconds", "steps", "seeds", "frames")}
    return {name: ",".join(_plain(value) for value in values) for name, values in many.items()}


def _plain(value: float | str) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)

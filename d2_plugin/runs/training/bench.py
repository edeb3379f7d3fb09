"""`d2 bench training`: D², stereo alone and the backbone at the same CPU time, on any number of recordings and seeds.

Each recording is written with the cameras that train, and those that score where not all others do:
PATH@00+02+05+07@01+03+04+06. Every run of one recording has the same starting points, depth inputs and settings,
and trains on one thread; its time is CPU time, which other work on the machine hardly changes. With `--seconds`, the
number of steps that a method trains in that time is found by trying, with the first seed. Rows are written as runs
finish, and the same command continues where it was stopped. `d2 report` draws them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, Literal, NamedTuple

from d2_plugin.errors import D2Error
from d2_plugin.reading import read_toml
from d2_plugin.recordings.presets import resolve_cameras, split_name
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, Preset, rows_named
from d2_plugin.runs.rows import TRY, Row, case_name, command_line
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings, check
from d2_plugin.runs.shared import Shared, share, share_points
from d2_plugin.runs.training.measured import Line, Work, by_key, follow, rows_in, unmeasured, workers, written
from d2_plugin.settings import AtATime, Count, Downscale, Positional, Range, Seed, Settings

PILOT = 100
"""Steps of the first try."""
TOLERANCE = 0.1
"""A run whose time is this near to the budget is the run of that budget."""
TRIES = 4
"""After so many the nearest counts; its own time stands beside its score."""
GROWTH = 1.1
"""Time ~ steps^GROWTH where only one length was tried: Gaussians become more."""

Timed = tuple[int, float]
"""Steps of a run, and the CPU seconds that it trained."""


@dataclass(frozen=True)
class TrainingBench(Settings):
    """Settings of `d2 bench training`."""

    recordings: Annotated[tuple[str, ...], Positional()] = ()
    """Recordings with their cameras, as PATH@TRAIN+TRAIN or PATH@TRAIN+TRAIN@SCORE+SCORE."""
    methods: tuple[str, ...] = ("backbone", "mvs_only", "full")
    """Rows or tables of `d2 ablate`."""
    seconds: tuple[Annotated[float, Range(1e-3, 1e7, unit="seconds")], ...] = ()
    """CPU seconds of training to compare at; 10, 30 and 100 if neither these nor steps are given."""
    steps: tuple[Annotated[int, Range(1, unit="steps")], ...] = ()
    """Numbers of steps to compare at."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds; a claim needs three."""
    backbone: str = "yang4d"
    """Name of a registered backbone."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames, in every recording; all if not given."""
    hold_out_instants: Annotated[int, Range(0, 10_000, unit="instants")] = 0
    """Train every so-manieth instant alone and score those between apart; 0 or 1 trains all."""
    downscale: Downscale = 1
    """Make images this many times smaller along each side."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth; the recordings' own maps if not given."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns."""
    multiview: str | None = None
    """Depth of all views from one network: a folder with FRAME.npz, or an ONNX file."""
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


def run(
    settings: TrainingBench,
    presets: Mapping[str, Preset] = PRESETS,
    tables: Mapping[str, Sequence[str]] = TABLES,
    name: str = "d2 bench training",
    about: Mapping[str, Any] | None = None,
) -> str:
    """Measure what is missing; where the rows lie.

    Args:
        presets, tables: methods by name, and tables of such names, that `settings.methods` may hold.
        name: of the command, as rows have it.
        about: further fields of every row.
    """
    if not settings.recordings:
        raise D2Error(f"{name} needs a recording with its cameras: write PATH@00+02+05+07")
    path = settings.output / "training.jsonl"
    known = rows_in(path)
    chosen = rows_named(settings.methods, presets, tables)
    command = command_line(name, settings)
    with workers(settings.jobs, settings.scheduler) as submit:  # or say that nobody answers, before priors are made
        lines = [line for text in settings.recordings for line in _lines(settings, text, chosen, known, command)]
        runs = len(lines) * len(set(settings.seeds)) * len(_targets(settings))
        with written(path, name, runs, **(about or {})) as write:
            follow(lines, submit, write)
    return f"rows are in {path}; `d2 report {quote(str(path))}` draws them"


class Case(NamedTuple):
    """One recording with its cameras."""

    name: str
    """As rows have it: the recording, how many cameras train, and the size where it is not the recording's own."""
    slug: str
    """Name of its folder."""
    settings: RunSettings


def case_of(text: str, base: RunSettings) -> Case:
    """The case that a text names; `base` gives all but recording and cameras.

    Raises:
        D2Error: no cameras, or more than two groups of them.
    """
    path, *groups = text.split("@")
    if not path or not 1 <= len(groups) <= 2 or not groups[0].strip("+"):
        raise D2Error(
            f"'{text}' names no cameras to train with: write PATH@00+02+05+07, or PATH@00+02@01+03 to say as well "
            "which ones score"
        )
    named = [tuple(name for name in group.split("+") if name) for group in groups]
    train, test, _ = resolve_cameras(path, named[0], named[1] if len(named) > 1 else None)
    protocol = split_name(named[0])
    settings = replace(base, recording=path, train_cameras=train, test_cameras=test, protocol=protocol)
    title = Path(os.path.realpath(path)).name
    slug = "_".join([title, *train]) + (f"_small{base.downscale}" if base.downscale > 1 else "")
    slug += f"_every{base.hold_out_instants}" if base.hold_out_instants > 1 else ""
    slug += f"_{protocol.replace(':', '_')}" if protocol else ""
    return Case(case_name(title, settings), slug, settings)


Target = tuple[Literal["seconds", "steps"], float]


def _targets(settings: TrainingBench) -> list[Target]:
    """What the methods are compared at, shortest first: what was tried for one helps the next."""
    seconds = settings.seconds or (() if settings.steps else (10.0, 30.0, 100.0))
    return [*(("steps", float(n)) for n in sorted(settings.steps)), *(("seconds", s) for s in sorted(seconds))]


def _lines(
    settings: TrainingBench, text: str, presets: Sequence[Preset], known: Sequence[Row], command: str
) -> Iterator[Line]:
    """One line per method of a case; points and priors are made here, before anything is measured."""
    shown = ("backbone", "frames", "hold_out_instants", "downscale", "mono_onnx", "mono_kind", "multiview")
    tables = {} if settings.config is None else read_toml(settings.config, "write TOML tables, or leave out --config")
    base = RunSettings("", (), **{n: getattr(settings, n) for n in shown}, overrides=tables)
    case = case_of(text, base)
    if not Scene.open(check(case.settings)).test_cameras:
        raise D2Error(f"all cameras of '{text}' train, so no run can be scored: leave one out")
    folder = settings.output.absolute() / case.slug
    cluster = None if settings.scheduler is None else {"scheduler": settings.scheduler}
    for preset in presets:
        share_points(case.settings, folder)
        used = replace(case.settings, overrides=preset.merged(case.settings.overrides))
        needed = preset.hooks or preset.guidance is not None
        shared = share(used, folder, cluster) if needed else Shared(folder, "none")
        yield line_of(Method(settings, case, shared, preset, command), known)


def line_of(method: Method, known: Sequence[Row]) -> Line:
    """All targets of one method: the length of a run is tried with the first seed, then the other seeds follow."""
    settings, case = method.settings, method.case
    by_run = by_key(known)
    trained = list(case.settings.train_cameras)
    mine = [
        row
        for row in by_run.values()
        if row["case"] == case.name and row["method"] == method.name and row["cameras"] == trained
    ]
    tried: list[Timed] = [(row["iterations"], row["seconds"]) for row in mine if row["seconds"]]

    for kind, size in _targets(settings):
        target, steps = (f"{size:g} s", 0) if kind == "seconds" else (f"{size:g} steps", round(size))
        if not steps:
            # What an earlier call chose for this time.
            steps = next((row["iterations"] for row in mine if row["target"] == target), 0)
            for _ in range(TRIES if not steps else 0):
                length = next_steps(size, tried)
                if any(length == n for n, _ in tried):
                    break
                rows = yield unmeasured([method.work(length, settings.seeds[0], TRY)], by_run)
                if any(row["failed"] for row in rows):
                    return
                tried += [(row["iterations"], row["seconds"]) for row in rows]
                if tried and fits(size, tried[-1]):
                    break
            steps = steps or nearest(size, tried)
        rows = yield unmeasured([method.work(steps, seed, target) for seed in settings.seeds], by_run)
        if rows and all(row["failed"] for row in rows):
            return
        tried += [(row["iterations"], row["seconds"]) for row in rows if row["seconds"]]


def next_steps(target: float, tried: Sequence[Timed]) -> int:
    """Steps to try for `target` seconds, from what was tried before: a power law through the two nearest."""
    if not tried:
        return PILOT
    lengths: dict[int, list[float]] = {}
    for steps, seconds in tried:
        lengths.setdefault(steps, []).append(max(seconds, 1e-3))
    means = [(steps, sum(seconds_of) / len(seconds_of)) for steps, seconds_of in lengths.items()]
    (steps, seconds), *others = sorted(means, key=lambda timed: abs(math.log(timed[1] / target)))
    power = GROWTH
    if others:  # the slope of log time over log steps, kept where the noise of short runs cannot lead astray
        power = math.log(others[0][1] / seconds) / math.log(others[0][0] / steps)
        power = min(max(power, 0.8), 2.0)
    return max(round(steps * (target / seconds) ** (1 / power)), 1)


def fits(target: float, timed: Timed) -> bool:
    """Whether a run took that long."""
    return abs(timed[1] / target - 1) <= TOLERANCE


def nearest(target: float, tried: Sequence[Timed]) -> int:
    """Steps of the run whose time is nearest to the budget, in ratio."""
    return min(tried, key=lambda timed: abs(math.log(max(timed[1], 1e-3) / target)))[0]


@dataclass(frozen=True)
class Method:
    """One method on one case, which makes its runs."""

    settings: TrainingBench
    case: Case
    shared: Shared
    preset: Preset
    command: str

    @property
    def name(self) -> str:
        """As rows have it."""
        name = f"{self.settings.backbone} {self.preset.name}"
        return f"{name}, {self.settings.label}" if self.settings.label else name

    @cached_property
    def prior_seconds(self) -> float | None:
        """CPU seconds of what its runs need of the prior."""
        return self.preset.seconds_of_prior(self.case.settings, self.shared)

    def work(self, steps: int, seed: int, target: str) -> Work:
        """One run of so many steps."""
        base, preset, shared = self.case.settings, self.preset, self.shared
        run = replace(base, hooks=preset.hooks, seed=seed, iterations=steps, overrides=preset.merged(base.overrides))
        guidance = None if preset.guidance is None else preset.guidance(steps)
        if run.hooks or guidance is not None:
            run = replace(run, priors=str(shared.priors))
        label = f"_{self.settings.label}".replace(" ", "_") if self.settings.label else ""
        folder = shared.folder / "runs" / base.backbone / f"{preset.name}{label}" / f"{steps}steps" / f"seed{seed}"
        about = {"prior_seconds": self.prior_seconds, "protocol": base.protocol}
        return Work(
            *(run, folder, shared.points, self.case.name, self.name, self.command, target, about), guidance=guidance
        )

"""`python -m benchmarks rivals-sweep`: weight and schedule of each rival, in short runs of one seed.

Sweep on cameras that no reported row trains: studio@01+03+04+06@00+02+05+07 where the reported rows have
studio@00+02+05+07@01+03+04+06. The best change of a rival is that with the highest mean PSNR over the recordings.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Literal

from benchmarks.rivals.table import PUBLISHED, RIVALS, preset
from d2_plugin.errors import D2Error
from d2_plugin.progress import progress_bar
from d2_plugin.runs.ablation.presets import PRESETS, Preset
from d2_plugin.runs.rows import Row, append_rows, command_line, read_rows
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.shared import share
from d2_plugin.runs.tables import Table, markdown
from d2_plugin.runs.training.bench import Case, case_of
from d2_plugin.runs.training.measured import Work, side_by_side
from d2_plugin.settings import AtATime, Count, Downscale, Positional, Seed, Settings, Steps

CAPTION = (
    "Every weight and schedule that was tried for a rival, in short runs of one seed on training cameras that no other "
    "row has. PSNR of held-out cameras as published and with the change whose mean over the recordings is highest; CPU "
    "seconds of all runs of a rival together. The best of many is a little too good."
)


@dataclass(frozen=True)
class RivalsSweep(Settings):
    """Settings of `python -m benchmarks rivals-sweep`."""

    recordings: Annotated[tuple[str, ...], Positional()] = ()
    """Recordings with their cameras, as PATH@TRAIN+TRAIN or PATH@TRAIN+TRAIN@SCORE+SCORE."""
    rivals: tuple[str, ...] = tuple(RIVALS)
    """Which are swept."""
    steps: Steps = 400
    """Of each run."""
    seed: Seed = 0
    """Of each run."""
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
    output: Path = Path("rivals-sweep")
    """Folder of priors, runs and rivals-sweep.jsonl."""


def run(settings: RivalsSweep) -> str:
    """Measure what is missing; the table, and where the rows lie."""
    if not settings.recordings:
        raise D2Error("the benchmark rivals-sweep needs a recording with its cameras: write PATH@00+02+05+07")
    path = settings.output / "rivals-sweep.jsonl"
    known = {(row["case"], row["method"], row["setting"], row["iterations"]) for row in _rows(path)}
    works = [work for text in settings.recordings for work in _works(settings, text)]
    missing = [work for work in works if (work.case, work.method, work.about["change"], settings.steps) not in known]
    with progress_bar("bench rivals-sweep", len(missing)) as bar:
        done = itertools.count(1)

        def write(row: Row) -> None:
            append_rows(path, [{**row, "setting": row["change"]}])
            bar.update(next(done), f"{row['case']}: {row['method']}, {row['change']}")

        side_by_side(missing, settings.jobs, write)
    return f"{markdown(table(_rows(path)))}\n\nrows are in {path}; `python -m benchmarks report` draws them"


def _rows(path: Path) -> list[Row]:
    return read_rows([path]) if path.is_file() else []


def _works(settings: RivalsSweep, text: str) -> Iterator[Work]:
    """Every run of a case; points and priors are made here."""
    shown = {name: getattr(settings, name) for name in ("frames", "downscale", "mono_onnx", "mono_kind", "seed")}
    case = case_of(text, RunSettings("", (), iterations=settings.steps, **shown))
    tried = [
        (name, str(change), preset(name, change))
        for name in settings.rivals
        for change in (PUBLISHED, *(change for change in RIVALS[name].swept if change != PUBLISHED))
    ]
    for name, change, chosen in [("backbone", "", PRESETS["backbone"]), *tried]:
        yield _work(settings, case, name, change, chosen)


def _work(settings: RivalsSweep, case: Case, name: str, change: str, chosen: Preset) -> Work:
    shared = share(case.settings, settings.output.absolute() / case.slug)
    guidance = None if chosen.guidance is None else chosen.guidance(settings.steps)
    used = replace(case.settings, hooks=(), overrides=chosen.merged({}))
    used = used if guidance is None else replace(used, priors=str(shared.priors))
    folder = shared.folder / "sweep" / name / (change.replace(" ", "_").replace(",", "") or "alone")
    about = (case.name, name, command_line("python -m benchmarks rivals-sweep", settings), f"{settings.steps} steps")
    return Work(used, folder, shared.points, *about, {"change": change}, kind="sweep", guidance=guidance)


def table(rows: Sequence[Row]) -> Table:
    """One line per rival: as published, at its best, and what the sweep cost."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    psnr = {(row["method"], row["setting"], row["case"]): row["scores"]["psnr"] for row in rows if row["scores"]}
    titles = ("method", "at its best", *(f"{case}: {what}" for case in cases for what in ("published", "best")))
    cells = []
    for name in dict.fromkeys(row["method"] for row in rows):
        best, published = best_change(rows, name), "" if name == "backbone" else str(PUBLISHED)
        found = [psnr.get((name, change, case)) for case in cases for change in (published, best)]
        scores = ["-" if value is None else f"{value:.2f}" for value in found]
        mine = [row for row in rows if row["method"] == name]
        cells.append((name, best, *scores, str(len(mine)), f"{sum(row['seconds'] for row in mine):.0f}"))
    return Table((*titles, "runs", "CPU s"), tuple(cells))


def best_change(rows: Sequence[Row], name: str) -> str:
    """The change of a rival, in words, with the highest mean PSNR over the recordings; a dash where none has scores."""
    scores: dict[str, list[float]] = {}
    for row in rows:
        if row["method"] == name and row["scores"]:
            scores.setdefault(row["setting"], []).append(row["scores"]["psnr"])
    most = max(map(len, scores.values()), default=0)
    most_tried = [change for change in scores if len(scores[change]) == most]
    return max(most_tried, key=lambda one: mean(scores[one]), default="-")

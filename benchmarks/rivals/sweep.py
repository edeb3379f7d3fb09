"""`python -m benchmarks rivals-sweep`: weight and schedule of each rival, in short runs of one seed.

Sweep on cameras that no reported row trains: studio@01+03+04+06@00+02+05+07 where the reported rows have
studio@00+02+05+07@01+03+04+06. The best change of a rival is that with the highest mean PSNR over the recordings.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

from benchmarks.rivals.table import PUBLISHED, RIVALS, preset
from benchmarks.short_runs import ShortRuns, measure_missing
from d2_plugin.runs.ablation.presets import PRESETS
from d2_plugin.runs.rows import Row, command_line
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.shared import share
from d2_plugin.runs.tables import Table
from d2_plugin.runs.training.bench import case_of
from d2_plugin.runs.training.measured import Work
from d2_plugin.settings import Seed, Steps

CAPTION = (
    "Every weight and schedule that was tried for a rival, in short runs of one seed on training cameras that no other "
    "row has. PSNR of held-out cameras as published and with the change whose mean over the recordings is highest; CPU "
    "seconds of all runs of a rival together. The best of many is a little too good."
)


@dataclass(frozen=True)
class RivalsSweep(ShortRuns):
    """Settings of `python -m benchmarks rivals-sweep`."""

    rivals: tuple[str, ...] = tuple(RIVALS)
    """Which are swept."""
    steps: Steps = 400
    """Of each run."""
    seed: Seed = 0
    """Of each run."""
    output: Path = Path("rivals-sweep")
    """Folder of priors, runs and rivals-sweep.jsonl."""


def run(settings: RivalsSweep) -> str:
    """Measure what is missing; the table, and where the rows lie."""
    path = settings.output / "rivals-sweep.jsonl"
    return measure_missing("rivals-sweep", settings, path, lambda text: _works(settings, text), tables)


def _works(settings: RivalsSweep, text: str) -> Iterator[Work]:
    """Every run of a case; points and priors are made here."""
    shown = {name: getattr(settings, name) for name in ("frames", "downscale", "mono_onnx", "mono_kind", "seed")}
    case = case_of(text, RunSettings("", (), iterations=settings.steps, **shown))
    tried = [
        (name, str(change), preset(name, change))
        for name in settings.rivals
        for change in (PUBLISHED, *(change for change in RIVALS[name].swept if change != PUBLISHED))
    ]
    shared = share(case.settings, settings.output.absolute() / case.slug)
    command, target = command_line("python -m benchmarks rivals-sweep", settings), f"{settings.steps} steps"
    for name, change, chosen in [("backbone", "", PRESETS["backbone"]), *tried]:
        guidance = None if chosen.guidance is None else chosen.guidance(settings.steps)
        used = replace(case.settings, hooks=(), overrides=chosen.merged({}))
        used = used if guidance is None else replace(used, priors=str(shared.priors))
        folder = shared.folder / "sweep" / name / (change.replace(" ", "_").replace(",", "") or "alone")
        about = (case.name, name, command, target, {"setting": change})
        yield Work(used, folder, shared.points, *about, kind="sweep", guidance=guidance)


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
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
    return [("Swept", Table((*titles, "runs", "CPU s"), tuple(cells)))]


def best_change(rows: Sequence[Row], name: str) -> str:
    """The change of a rival, in words, with the highest mean PSNR over the recordings; a dash where none has scores."""
    scores: dict[str, list[float]] = {}
    for row in rows:
        if row["method"] == name and row["scores"]:
            scores.setdefault(row["setting"], []).append(row["scores"]["psnr"])
    most = max(map(len, scores.values()), default=0)
    most_tried = [change for change in scores if len(scores[change]) == most]
    return max(most_tried, key=lambda one: mean(scores[one]), default="-")

"""`python -m benchmarks never-worse`: is D² with wrong monocular maps worse than the backbone alone, or than stereo
alone?

Each recording is written with the cameras that train, and those that score where not all others do:
PATH@00+02+05+07@01+03+04+06. All runs of one recording start from the same points and see the same images; the prior of
each is built anew from its own maps, with the same geometric depth. Rows are written as runs finish, and the same
command continues where it was stopped. `python -m benchmarks report` draws them.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from benchmarks.never_worse.maps import spoiled_recording
from benchmarks.short_runs import ShortRuns, measure_missing
from d2_plugin.errors import D2Error
from d2_plugin.runs.ablation.presets import PRESETS
from d2_plugin.runs.prior.build import build_priors_for
from d2_plugin.runs.report.quality import groups_of, scores_table
from d2_plugin.runs.rows import Row, command_line
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings, check, prior_settings
from d2_plugin.runs.shared import Shared, share
from d2_plugin.runs.start import TimedPoints
from d2_plugin.runs.tables import Table
from d2_plugin.runs.training.bench import Case, case_of
from d2_plugin.runs.training.measured import Work
from d2_plugin.settings import Range, Seed

BACKBONE, STEREO = "backbone alone", "stereo alone"
"""Methods that use no monocular map."""

CAPTION = (
    "Held-out scores where the monocular maps are not what they should be: `noise` is a random value at every pixel, "
    "`smooth` random blobs, `constant` one value, `other` the map of another frame (of another camera where there is "
    "one frame), `network` a small network that runs on phones. `stereo alone` uses no monocular map."
)

Maps = Literal["own", "noise", "smooth", "constant", "other", "network"]


@dataclass(frozen=True)
class NeverWorseBench(ShortRuns):
    """Settings of `python -m benchmarks never-worse`."""

    maps: tuple[Maps, ...] = ("own", "noise", "smooth", "constant", "other", "network")
    """Monocular maps: the recording's own (a network's where it has none), random pixels, random blobs, one value,
    those of another frame (of another camera where there is one frame), and a network's."""
    steps: Annotated[int, Range(1, unit="steps")] = 1000
    """Optimizer steps of each run, one view each."""
    seeds: tuple[Seed, ...] = (0,)
    """Seeds."""
    backbone: str = "yang4d"
    """Name of a registered backbone."""
    output: Path = Path("never-worse")
    """Folder of recordings, priors, runs and never-worse.jsonl."""


def run(settings: NeverWorseBench) -> str:
    """Measure what is missing; the table, and where the rows lie."""
    path = settings.output / "never-worse.jsonl"
    return measure_missing("never-worse", settings, path, lambda text: _works(settings, text), tables)


def tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """The scores of each recording, by what the monocular maps were."""
    return [("Scores", scores_table(groups_of([{**row, "method": f"yang4d {row['method']}"} for row in rows])))]


def _works(settings: NeverWorseBench, text: str) -> Iterator[Work]:
    """Every run of a case; points and priors are made here, one after the other."""
    shown = {name: getattr(settings, name) for name in ("backbone", "frames", "downscale")}
    base = RunSettings("", (), iterations=settings.steps, **shown)
    case = case_of(text, base)
    network = replace(case.settings, mono_onnx=settings.mono_onnx, mono_kind=settings.mono_kind)
    own = _own(case, network)
    folder = settings.output.absolute() / case.slug
    shared = share(own, folder)
    methods = [(BACKBONE, own, PRESETS["backbone"]), (STEREO, own, PRESETS["mvs_only"])]
    for maps in settings.maps:
        used = _with_maps(maps, case, own, network, folder)
        if used is not None:
            methods.append((maps, used, PRESETS["full"]))
    command, target = command_line("python -m benchmarks never-worse", settings), f"{base.iterations} steps"
    for method, given, preset in methods:
        name = method.replace(" ", "_")
        store = folder / "priors" / name
        chosen = replace(given, hooks=preset.hooks, overrides=preset.merged(given.overrides), priors=str(store))
        about = {"prior": _build(chosen, store, shared) if preset.hooks else None, "frames": given.frames}
        for seed in settings.seeds:
            output = folder / "runs" / name / f"{given.iterations}steps" / f"seed{seed}"
            one = replace(chosen, seed=seed), output, shared.points
            yield Work(*one, case.name, method, command, target, about, kind="never_worse")


def _build(settings: RunSettings, store: Path, shared: Shared) -> str:
    """The prior of one method, with the geometric depth of the full one; what it became, in a line."""
    if not store.exists():
        shutil.copytree(shared.priors, store, ignore=shutil.ignore_patterns("priors", "matches", "mono"))
    points = TimedPoints.load(shared.points).positions
    settings = check(settings)
    return build_priors_for(Scene.open(settings), points, store).headline()


def _own(case: Case, network: RunSettings) -> RunSettings:
    """The case with the maps that belong to it: on disk, else the network's."""
    recording = Scene.open(check(case.settings)).recording
    if recording.mono_kind is not None:
        return case.settings
    if network.mono_onnx is None:
        raise D2Error(f"{case.name} has no monocular maps: give a network by --mono-onnx FILE --mono-kind relative")
    return network


def _with_maps(maps: Maps, case: Case, own: RunSettings, network: RunSettings, folder: Path) -> RunSettings | None:
    """The case with other maps; None where they are those that it has, or where there is no network."""
    if maps == "own":
        return own
    if maps == "network":
        return None if network.mono_onnx is None or own is network else network
    shown = Path(own.recording), own.train_cameras, own.frames
    path = spoiled_recording(*shown, maps, folder / "maps" / maps, prior_settings(own))
    return replace(case.settings, recording=str(path))

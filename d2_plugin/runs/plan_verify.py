"""`d2 plan --verify`: each decision of the plan taken both ways on the recording itself, with its saving and its cost.

Time and memory are those of the work that the decision is about (training, or building priors), each measured in a
process of its own. The cost of leaving a part out is what is lost without it, in held-out dB or in verified pixels;
a negative cost is a gain. With at least three seeds the cost has a verdict.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, stdev
from typing import Annotated, Any, Literal

import numpy as np

from d2_plugin.recordings.presets import resolve_cameras
from d2_plugin.runs.command_line import command_line
from d2_plugin.runs.markup import markdown
from d2_plugin.runs.memory import Measured, in_fresh_process
from d2_plugin.runs.report.limits import plan as plan_section
from d2_plugin.runs.rows import Row, append_rows, begin_rows, make_row
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check
from d2_plugin.runs.verdict import LEAST_SEEDS
from d2_plugin.settings import Count, Positional, Range, Seed, Settings

USED, LEFT_OUT = "used", "left out"


@dataclass(frozen=True)
class PlanVerification(Settings):
    """Settings of `d2 plan RECORDING --verify`."""

    recording: Annotated[str, Positional()]
    """Folder of the recording."""
    train_cameras: tuple[str, ...]
    """Names of the cameras that train; or preset:2, preset:3, preset:4 for a known data set."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames to use; all if not given."""
    downscale: Annotated[int, Range(1)] = 1
    """Make images this many times smaller."""
    mono_onnx: str | None = None
    """Monocular depth network as an ONNX file."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the network predicts: inverse depth up to scale and shift (relative) or depth (metric)."""
    iterations: Annotated[int, Range(1, unit="steps")] = 300
    """Optimizer steps of each training."""
    prior_frames: Annotated[int, Range(1)] = 6
    """Number of frames over which priors are built, from the first one."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds of the trainings. A verdict needs at least three."""
    output: Path = Path("runs.jsonl")
    """File that the rows are added to."""


def run(settings: PlanVerification) -> str:
    """Take each decision both ways and add the rows; the table, and where the rows lie."""
    begin_rows(settings.output)
    train, test, notes = resolve_cameras(settings.recording, settings.train_cameras, None)
    base = RunSettings(
        settings.recording,
        train,
        test_cameras=test,
        frames=settings.frames,
        downscale=settings.downscale,
        mono_onnx=settings.mono_onnx,
        mono_kind=settings.mono_kind,
    )
    rows = verify(base, settings.iterations, settings.prior_frames, settings.seeds, _command(settings))
    append_rows(settings.output, rows)
    told = [*(f"note: {note}" for note in notes), table(rows)]
    if len(settings.seeds) < LEAST_SEEDS:
        told.append(f"{len(settings.seeds)} seeds are too few for a verdict: give at least {LEAST_SEEDS} with --seeds")
    return "\n".join([*told, f"rows are in {settings.output}; `d2 report {settings.output}` shows them"])


def _command(settings: PlanVerification) -> str:
    frames = settings.frames
    written = {} if frames is None else {"frames": _range(frames)}
    return command_line("plan --verify", settings, comma=True, **written)


def _range(frames: Sequence[int]) -> str:
    """Frames as first:last:step where they are evenly spaced, each one otherwise."""
    steps = {later - earlier for earlier, later in itertools.pairwise(frames)}
    if len(steps) != 1:
        return ",".join(map(str, frames))
    (step,) = steps
    return f"{frames[0]}:{frames[-1]}" + (f":{step}" if step != 1 else "")


@dataclass(frozen=True)
class Question:
    """A decision, what the plan says, and the settings of a run either way; or why it cannot be taken otherwise."""

    name: str
    planned: str
    unit: str
    settings: Mapping[str, RunSettings]
    trains: bool = True
    settled: str | None = None


def verify(
    settings: RunSettings,
    iterations: int = 300,
    prior_frames: int = 6,
    seeds: Sequence[int] = (0, 1, 2),
    command: str = "",
) -> list[Row]:
    """Two rows per decision: with the part and without it, means over the seeds.

    Args:
        settings: recording, cameras and monocular source, as for a run.
        iterations: optimizer steps of each training, on all frames.
        prior_frames: frames over which priors are built, from the first one.
        seeds: of the trainings; a verdict needs three.
        command: how this was started.

    Raises:
        D2Error: the settings are not those of a possible run.
    """
    base = replace(check(settings), iterations=iterations)
    scene = Scene.open(base)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for question in questions(base, scene, prior_frames):
            rows += _answer(question, scene.recording.name, Path(folder), seeds, command)
    return rows


def questions(base: RunSettings, scene: Scene, prior_frames: int) -> list[Question]:
    """The decisions that can be taken either way on this recording, and those that cannot, with the reason."""
    said = {decision.name: decision for decision in scene.plan.decisions}
    stereo = said["stereo"].use
    some = tuple(scene.recording.frames[:prior_frames])
    reuse = {
        USED: _with(replace(base, frames=some), "priors", stereo={"reuse_static": False}),
        LEFT_OUT: replace(base, frames=some),
    }
    hooks = replace(base, hooks=HOOK_NAMES if stereo else HOOK_NAMES[:2])
    bare = replace(base, hooks=())
    temporal = {way: _with(bare, "plan", temporal=way == USED) for way in (USED, LEFT_OUT)}
    retiring = {USED: _with(hooks, "d2", retire_after=0), LEFT_OUT: hooks}
    in_db = "dB held out" if scene.test_cameras else "dB on training views"
    return [
        Question("temporal dimension", _said(said["temporal"].use, said["temporal"].reason), in_db, temporal),
        Question("stereo", _said(stereo, said["stereo"].reason), "-", {}, settled=_stereo_is_settled(stereo)),
        Question(
            *("matching static pixels again", "left out: a static pixel is matched once per block of frames"),
            *("of the pixels verified", reuse),
            trains=False,
            settled=None if stereo and len(some) > 1 else "there is no second frame or no stereo",
        ),
        Question(
            *("hooks that change nothing", "left out: a hook retires after idle evaluations", in_db, retiring),
            settled=None if any(said[name].use for name in ("stereo", "monocular")) else "there is no depth prior",
        ),
    ]


def _said(use: bool, reason: str) -> str:
    return f"{USED if use else LEFT_OUT}: {reason}"


def _stereo_is_settled(use: bool) -> str:
    if use:
        return "geometric depth is half of the method: `d2 ablate` measures it"
    return "it cannot be used: there is no second point of view"


def _with(settings: RunSettings, table: str, **values: Any) -> RunSettings:
    """The settings with some of a table's entries replaced."""
    overrides = dict(settings.overrides)
    overrides[table] = {**overrides.get(table, {}), **values}
    return replace(settings, overrides=overrides)


def _answer(question: Question, case: str, folder: Path, seeds: Sequence[int], command: str) -> list[Row]:
    about = {"planned": question.planned, "unit": question.unit, "command": command}
    if question.settled is not None:
        return [make_row("plan", case, question.name, "-", error=None, seconds=None, failed=question.settled, **about)]
    found = {way: _runs(question, way, folder, seeds) for way in question.settings}
    return [
        make_row(
            *("plan", case, question.name, way),
            error=mean(costs) if costs else None,
            seconds=mean(run.result["seconds"] for run in runs),
            peak_mb=mean(run.peak_mb for run in runs),
            cost=mean(costs) if costs else None,
            cost_deviation=stdev(costs) if len(costs) > 1 else None,
            gaussians=round(mean(run.result["gaussians"] for run in runs)) if question.trains else None,
            seeds=list(seeds) if question.trains else None,
            details=[run.result for run in runs],
            **about,
        )
        for way, runs in found.items()
        for costs in [_costs(found[USED], runs)]
    ]


def _runs(question: Question, way: str, folder: Path, seeds: Sequence[int]) -> list[Measured]:
    """One training per seed, all looking at one prior, or a build of the prior."""
    place = folder / question.name.replace(" ", "-") / way.replace(" ", "-")
    settings = question.settings[way]
    if not question.trains:
        return [in_fresh_process(_build, settings, place)]
    if settings.hooks:
        settings = replace(settings, priors=str(folder / "priors"))
        # The prior is built in a process of its own, so that its memory does not count as that of a training.
        in_fresh_process(_prepare, settings, place / "prepared")
    return [in_fresh_process(_train, replace(settings, seed=seed), place / str(seed)) for seed in seeds]


def _costs(used: Sequence[Measured], runs: Sequence[Measured]) -> list[float]:
    """What each seed loses against the same seed with the part; empty where there was no score."""
    pairs = [(one.result["score"], other.result["score"]) for one, other in zip(used, runs)]
    return [] if any(None in pair for pair in pairs) else [one - other for one, other in pairs]


def _prepare(settings: RunSettings, folder: Path) -> None:
    from d2_plugin.runs.run import Run

    Run(settings, folder).prepare()


def _train(settings: RunSettings, folder: Path) -> dict[str, Any]:
    """Train and score; the seconds are those of training alone."""
    from d2_plugin.runs.run import Run

    run = Run(settings, folder)
    run.prepare()
    run.train()
    metrics = run.evaluate(images=False)
    scores = metrics["test"] or metrics["train"]
    return {"score": scores["psnr"], "seconds": run.seconds["train"], "gaussians": metrics["gaussians"]}


def _build(settings: RunSettings, folder: Path) -> dict[str, Any]:
    """Build the priors; the score is the verified share, with the median error of those pixels where truth is known."""
    from d2_plugin.runs.prior.build import build_priors_for
    from d2_plugin.runs.start import triangulated_points
    from d2_plugin.store.store import PriorStore

    scene = Scene.open(settings)
    points = triangulated_points(scene.recording, scene.train_cameras).positions
    start = time.perf_counter()
    build_priors_for(settings, scene, points, folder)
    seconds = time.perf_counter() - start
    store, views = PriorStore.open(folder), [(c, f) for c in scene.train_cameras for f in scene.recording.frames]
    records = [store.record(camera, frame) for camera, frame in views]
    shares = [record["shares"]["verified"] for record in records if record is not None]
    errors = [error for view in views for error in _errors(scene, store.prior(*view), *view)]
    median = float(np.median(np.concatenate(errors))) if errors else None
    return {"score": mean(shares), "seconds": seconds, "median_error": median}


def _errors(scene: Scene, prior: Any, camera: str, frame: int) -> list[np.ndarray]:
    """Relative errors of the verified pixels of one view, or nothing where the true depth is unknown."""
    truth = scene.recording.depth(camera, frame)
    if prior is None or truth is None:
        return []
    depth, verified = prior.depth.numpy(), prior.verified.numpy() & (truth > 0)
    return [np.abs(depth[verified] / truth[verified] - 1)]


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown."""
    return markdown(plan_section(rows).tables[0][1])

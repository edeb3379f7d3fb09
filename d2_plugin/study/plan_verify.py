"""`d2 plan --verify`: each decision of the plan taken both ways on the capture itself, with its saving and its cost.

Time and memory are those of the work that the decision is about (training, or building priors), each measured in a
process of its own. The cost is what leaving the part out loses: held-out dB, or verified pixels; negative is a gain.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np

from d2_plugin.captures.presets import resolve_cameras
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check
from d2_plugin.study.bench.memory import Measured, in_fresh_process
from d2_plugin.study.report.limits import plan as plan_section
from d2_plugin.study.report.page import markdown_table

from .rows import Row, append_rows, make_row

USED, LEFT_OUT = "used", "left out"


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
        settings: capture, cameras and monocular source, as for a run.
        iterations: optimizer steps of each training, on all frames.
        prior_frames: frames over which priors are built, from the first one.
        seeds: of the trainings; a single one tells nothing about differences below a few tenths of a dB.
        command: how this was started.

    Raises:
        D2Error: the settings are not those of a possible run.
    """
    base = replace(check(settings), iterations=iterations)
    scene = Scene.open(base)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for question in questions(base, scene, prior_frames):
            rows += _answer(question, scene.capture.name, Path(folder), seeds, command)
    return rows


def questions(base: RunSettings, scene: Scene, prior_frames: int) -> list[Question]:
    """The decisions that can be taken either way on this capture, and those that cannot, with the reason."""
    said = {decision.name: decision for decision in scene.plan.decisions}
    stereo = said["stereo"].use
    some = tuple(scene.capture.frames[:prior_frames])
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
        in_fresh_process(_prepare, settings, place / "prepared")  # building the prior is in nobody's memory
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
    metrics = run.evaluate(pictures=False)
    scores = metrics["test"] or metrics["train"]
    return {"score": scores["psnr"], "seconds": run.seconds["train"], "gaussians": metrics["gaussians"]}


def _build(settings: RunSettings, folder: Path) -> dict[str, Any]:
    """Build the priors; the score is the verified share, with the median error of those pixels where truth is known."""
    from d2_plugin.priors.store import PriorStore
    from d2_plugin.runs.run import build_priors_for
    from d2_plugin.runs.start import triangulated_points

    scene = Scene.open(settings)
    points = triangulated_points(scene.capture, scene.train_cameras)["positions"]
    start = time.perf_counter()
    build_priors_for(settings, scene, points, folder)
    seconds = time.perf_counter() - start
    store, views = PriorStore.open(folder), [(c, f) for c in scene.train_cameras for f in scene.capture.frames]
    shares = [store.record(camera, frame)["shares"]["verified"] for camera, frame in views]
    errors = [error for view in views for error in _errors(scene, store.prior(*view), *view)]
    median = float(np.median(np.concatenate(errors))) if errors else None
    return {"score": mean(shares), "seconds": seconds, "median_error": median}


def _errors(scene: Scene, prior: Any, camera: str, frame: int) -> list[np.ndarray]:
    """Relative errors of the verified pixels of one view, or nothing where the true depth is unknown."""
    truth = scene.capture.depth(camera, frame)
    if prior is None or truth is None:
        return []
    depth, verified = prior.depth.numpy(), prior.verified.numpy() & (truth > 0)
    return [np.abs(depth[verified] / truth[verified] - 1)]


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown."""
    return markdown_table(plan_section(rows).tables[0][1])


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _seeds(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in _names(text))


def _frames(text: str) -> tuple[int, ...]:
    first, last, *step = (int(part) for part in text.split(":"))  # argparse names the option when this raises
    return tuple(range(first, last + 1, *step))


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `d2 plan CAPTURE --verify`."""
    parser = argparse.ArgumentParser(prog="d2 plan --verify", description=__doc__)
    parser.add_argument("capture", help="folder of the recording")
    parser.add_argument("--train-cameras", required=True, type=_names, help="names joined by commas, or preset:4")
    parser.add_argument("--frames", type=_frames, default=None, help="first:last or first:last:step; default all")
    parser.add_argument("--downscale", type=int, default=1, help="pictures this many times smaller (integer); 1")
    parser.add_argument("--mono-onnx", default=None, help="monocular depth network as an ONNX file")
    parser.add_argument("--mono-kind", choices=("relative", "metric"), default=None, help="inverse depth or depth")
    parser.add_argument("--iterations", type=int, default=300, help="optimizer steps of each training; 300")
    parser.add_argument("--prior-frames", type=int, default=6, help="frames over which priors are built; 6")
    parser.add_argument("--seeds", type=_seeds, default=(0, 1, 2), help="of the trainings, joined by commas; 0,1,2")
    parser.add_argument("--output", type=Path, default=Path("runs.jsonl"), help="rows are added to it; runs.jsonl")
    options = parser.parse_args(arguments)
    train, test, _ = resolve_cameras(options.capture, options.train_cameras, None)
    settings = RunSettings(
        options.capture,
        train,
        test_cameras=test,
        frames=options.frames,
        downscale=options.downscale,
        mono_onnx=options.mono_onnx,
        mono_kind=options.mono_kind,
    )
    command = shlex.join(["d2", "plan", "--verify", *(arguments or ())])
    rows = verify(settings, options.iterations, options.prior_frames, options.seeds, command)
    append_rows(options.output, rows)
    sys.stdout.write(f"{table(rows)}\nrows are in {options.output}\n")
    return 0

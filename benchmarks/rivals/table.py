"""`python -m benchmarks rivals`: the training bench with what users would pick instead of D², at equal time or steps.

Each rival is the published formula on the same backbone, points and depth inputs as D², once with its published weight
and schedule and once with those that were best in `python -m benchmarks rivals-sweep`. All else is as `d2 bench
training` has it.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from benchmarks.rivals.dense_start import DenseStartConfig, dense_points, feed_forward_points
from benchmarks.rivals.inputs import Inputs
from benchmarks.rivals.patch_norm import PatchNorm, PatchNormConfig
from benchmarks.rivals.pearson import Pearson, PearsonConfig
from benchmarks.rivals.scale_shift import ScaleShift, ScaleShiftConfig
from benchmarks.rivals.sparse_points import SparsePointDepth, SparsePointsConfig
from d2_plugin.hooks import Hook
from d2_plugin.priors.monocular.network import MonocularModel
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, Preset
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check
from d2_plugin.runs.start import TimedPoints
from d2_plugin.runs.training import bench

Needs = Literal["points", "mono", "stereo"]


BLACK = {"backbone": {"background": False}}
"""What is drawn stands before black, not before a background that learns."""


@dataclass(frozen=True)
class Change:
    """What of a rival is set otherwise than published."""

    times: float = 1.0
    """Factor of its weight; of the density of a dense start."""
    until: float = 1.0
    """Share of the run that it acts in, from the first step."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Settings of its own."""
    tables: Mapping[str, Any] | None = None
    """Settings of the run, in place of the rival's own."""

    def of(self, config: Any, iterations: int) -> Any:
        """The rival's settings for a run of so many steps, changed."""
        scaled = "weight" if hasattr(config, "weight") else "density"
        changed = {scaled: getattr(config, scaled) * self.times, **self.fields}
        if self.until < 1:
            changed["stop"] = round(self.until * iterations) + 1
        return replace(config, **changed)

    def __str__(self) -> str:
        parts = [f"{self.times:g} times"] if self.times != 1 else []
        parts += [f"first {self.until:.0%}"] if self.until < 1 else []
        parts += ["hard depth alone"] if self.fields == HARD else [f"{n} {v}" for n, v in self.fields.items()]
        parts += [] if self.tables is None else ["before black" if self.tables == BLACK else "learnt background"]
        return ", ".join(parts) or "as published"


PUBLISHED = Change()
HARD = {"soft_start": 10**9}
"""DNGaussian without its soft depth."""


@dataclass(frozen=True)
class Rival:
    """One row of the table."""

    title: str
    """Method and source, for people."""
    needs: Needs
    """What it takes of the prior: the sparse points alone, monocular maps, or stereo."""
    config: Callable[[int], Any]
    """Its settings for a run of so many steps."""
    hook: Callable[[Any, Inputs], Hook] | None = None
    start: Callable[[Inputs, Any], TimedPoints] | None = None
    tables: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run that belong to it."""
    swept: Sequence[Change] = ()
    """What `python -m benchmarks rivals-sweep` tries beside what is published."""
    best: Change = PUBLISHED
    """The best of it, in the rows of docs/results/rivals-sweep.jsonl."""


RIVALS: dict[str, Rival] = {
    "pearson": Rival(
        *("Pearson depth (FSGS)", "mono", PearsonConfig.for_iterations, Pearson),
        swept=(Change(0.03), Change(0.1), Change(0.3), Change(0.3, 0.5), Change(1, 0.5), Change(3)),
        best=Change(0.03),
    ),
    "scale_shift": Rival(
        *("Scale-and-shift-invariant depth (nerfstudio)", "mono", ScaleShiftConfig.for_iterations, ScaleShift),
        swept=(Change(0.1), Change(0.3), Change(1, 0.5), Change(3), Change(3, 0.5), Change(10)),
    ),
    "patch_norm": Rival(
        *("Patch-normalised depth (DNGaussian)", "mono", PatchNormConfig.for_iterations, PatchNorm),
        tables=BLACK,
        swept=(
            Change(0.1),
            *(Change(times, fields=HARD) for times in (0.1, 1)),
            *(Change(times, until, HARD, {}) for times, until in ((0.01, 1), (0.1, 1), (1, 1), (1, 0.5))),
            Change(0.01, tables={}),
        ),
        best=Change(0.01, fields=HARD, tables={}),
    ),
    "sparse_points": Rival(
        *("Sparse-point depth (gsplat)", "points", SparsePointsConfig.for_iterations, SparsePointDepth),
        swept=(Change(3), Change(10), Change(10, 0.5), Change(100)),
        best=Change(3),
    ),
    "dense_start": Rival(
        *("Dense start (GC-4DGS)", "stereo", lambda iterations: DenseStartConfig()),
        start=dense_points,
        swept=(Change(0.5), Change(2), Change(4), Change(fields={"instants": 1})),
        best=Change(4),
    ),
}

STARTS = {
    "feed_forward": Rival(
        *("Feed-forward start, emulated", "stereo", lambda iterations: DenseStartConfig()), start=feed_forward_points
    ),
}
"""No rival but a good start, from which the backbone alone and D² are trained."""


@dataclass(frozen=True)
class RivalGuidance:
    """A rival as the guidance of a run (`d2_plugin.runs.scene.Guidance`)."""

    name: str
    config: Any

    def identity(self) -> Mapping[str, Any]:
        """Its name and settings."""
        return {"name": self.name} | asdict(self.config)

    def start(self, scene: Scene, points: TimedPoints, priors: Path) -> TimedPoints:
        """Its own points where it brings some, else the triangulated ones."""
        start = (RIVALS | STARTS)[self.name].start
        return points if start is None else start(Inputs(scene, points, priors), self.config)

    def hooks(self, scene: Scene, points: TimedPoints, priors: Path) -> Mapping[str, Hook]:
        """Its hook, if it has one."""
        hook = (RIVALS | STARTS)[self.name].hook
        return {} if hook is None else {self.name: hook(self.config, Inputs(scene, points, priors))}


def guidance(name: str, iterations: int, change: Change = PUBLISHED) -> RivalGuidance:
    """The rival of that name for a run of so many steps, as published but for the change."""
    return RivalGuidance(name, change.of((RIVALS | STARTS)[name].config(iterations), iterations))


def prior_seconds(needs: Needs, settings: RunSettings, full: float | None) -> float | None:
    """CPU seconds of what a rival needs: nothing, monocular maps alone, or the full prior's, which `full` is."""
    if needs == "mono":
        return monocular_seconds(settings)
    return 0.0 if needs == "points" else full


def monocular_seconds(settings: RunSettings) -> float:
    """CPU time of the monocular maps alone: 0 for maps on disk, else one prediction, times as many as there are."""
    scene = Scene.open(check(settings))
    chosen = scene.priors
    if not chosen.mono_onnx or chosen.mono_kind is None:
        return 0.0
    model = MonocularModel(chosen.mono_onnx, chosen.mono_kind, chosen.mono_preprocessing, chosen.mono_threads)
    image = scene.recording.image(scene.train_cameras[0], scene.recording.frames[0])
    start = time.process_time()
    model.predict(image)
    return (time.process_time() - start) * len(scene.train_cameras) * len(scene.recording.frames)


def preset(name: str, change: Change = PUBLISHED, label: str = "", hooks: tuple[str, ...] = ()) -> Preset:
    """A rival as a row of a comparison, with D²'s `hooks` beside it; `label` stands behind its name."""
    rival = (RIVALS | STARTS)[name]
    return Preset(
        *(name + label, rival.title, hooks),
        overrides=rival.tables if change.tables is None else change.tables,
        guidance=partial(guidance, name, change=change),
        prior_seconds=partial(prior_seconds, rival.needs),
    )


RIVAL_PRESETS = {
    made.name: made for name, rival in RIVALS.items() for made in (preset(name), preset(name, rival.best, "_best"))
} | {"feed_forward": preset("feed_forward"), "feed_forward_d2": preset("feed_forward", label="_d2", hooks=HOOK_NAMES)}


@dataclass(frozen=True)
class RivalsBench(bench.TrainingBench):
    """Settings of `python -m benchmarks rivals`."""

    methods: tuple[str, ...] = ("rivals",)
    """Rows or tables of `d2 ablate`, and rivals; `rivals` stands for the backbone, all of them and D²,
    `rivals_best` for the same with each rival at its best, `starts` for an emulated feed-forward start."""


def run(settings: RivalsBench) -> str:
    """Measure what is missing; where the rows lie."""
    best = tuple(f"{name}_best" for name in RIVALS)
    tables = TABLES | {"rivals": ("backbone", *RIVALS, "full"), "rivals_best": ("backbone", *best, "full")}
    tables |= {"starts": ("backbone", "feed_forward", "feed_forward_d2", "full")}
    return bench.run(settings, PRESETS | RIVAL_PRESETS, tables, "python -m benchmarks rivals")

"""`python -m benchmarks rivals`: the training bench with what users would pick instead of D², at equal time or steps.

Each rival is the published formula with its published weight, on the same backbone, points and depth inputs as D². All
else is as `d2 bench training` has it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from benchmarks.rivals.dense_start import DenseStartConfig, dense_points
from benchmarks.rivals.inputs import Inputs
from benchmarks.rivals.patch_norm import PatchNorm, PatchNormConfig
from benchmarks.rivals.pearson import Pearson, PearsonConfig
from benchmarks.rivals.scale_shift import ScaleShift, ScaleShiftConfig
from benchmarks.rivals.sparse_points import SparsePointDepth, SparsePointsConfig
from d2_plugin.hooks import Hook
from d2_plugin.priors.monocular.network import MonocularModel
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, Preset
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings, check
from d2_plugin.runs.start import TimedPoints
from d2_plugin.runs.training import bench

Needs = Literal["points", "mono", "stereo"]


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


RIVALS: dict[str, Rival] = {
    "pearson": Rival("Pearson depth (FSGS)", "mono", PearsonConfig.for_iterations, Pearson),
    "scale_shift": Rival(
        "Scale-and-shift-invariant depth (nerfstudio)", "mono", ScaleShiftConfig.for_iterations, ScaleShift
    ),
    "patch_norm": Rival("Patch-normalised depth (DNGaussian)", "mono", PatchNormConfig.for_iterations, PatchNorm),
    "sparse_points": Rival(
        "Sparse-point depth (gsplat)", "points", SparsePointsConfig.for_iterations, SparsePointDepth
    ),
    "dense_start": Rival("Dense start (GC-4DGS)", "stereo", lambda iterations: DenseStartConfig(), start=dense_points),
}


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
        start = RIVALS[self.name].start
        return points if start is None else start(Inputs(scene, points, priors), self.config)

    def hooks(self, scene: Scene, points: TimedPoints, priors: Path) -> Mapping[str, Hook]:
        """Its hook, if it has one."""
        hook = RIVALS[self.name].hook
        return {} if hook is None else {self.name: hook(self.config, Inputs(scene, points, priors))}


def guidance(name: str, iterations: int) -> RivalGuidance:
    """The rival of that name with its published settings, for a run of so many steps."""
    return RivalGuidance(name, RIVALS[name].config(iterations))


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


RIVAL_PRESETS = {
    name: Preset(name, rival.title, (), {}, partial(guidance, name), partial(prior_seconds, rival.needs))
    for name, rival in RIVALS.items()
}


@dataclass(frozen=True)
class RivalsBench(bench.TrainingBench):
    """Settings of `python -m benchmarks rivals`."""

    methods: tuple[str, ...] = ("rivals",)
    """Rows or tables of `d2 ablate`, and rivals; `rivals` stands for the backbone, all of them and D²."""


def run(settings: RivalsBench) -> str:
    """Measure what is missing; where the rows lie."""
    tables = TABLES | {"rivals": ("backbone", *RIVALS, "full")}
    return bench.run(settings, PRESETS | RIVAL_PRESETS, tables, "bench rivals")

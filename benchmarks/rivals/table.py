"""The one list of rivals: name, title, source of its depth, and how it is made from its settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.rivals.dense_start import DenseStartConfig, dense_points
from benchmarks.rivals.inputs import Inputs
from benchmarks.rivals.patch_norm import PatchNorm, PatchNormConfig
from benchmarks.rivals.pearson import Pearson, PearsonConfig
from benchmarks.rivals.scale_shift import ScaleShift, ScaleShiftConfig
from benchmarks.rivals.sparse_points import SparsePointDepth, SparsePointsConfig
from d2_plugin.errors import unknown_name
from d2_plugin.hooks import Hook
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.start import TimedPoints

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


def rival(name: str | None, iterations: int) -> RivalGuidance | None:
    """The rival of that name with its published settings, for a run of so many steps; None for None.

    Raises:
        D2Error: an unknown name.
    """
    if name is None:
        return None
    if name not in RIVALS:
        raise unknown_name("rival", name, RIVALS)
    return RivalGuidance(name, RIVALS[name].config(iterations))

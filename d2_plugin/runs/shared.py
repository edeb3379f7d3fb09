"""What the runs of one comparison share: starting points and depth priors, each made once; and one such run."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from d2_plugin.durable import Kind, make_folder, read_table, write_table
from d2_plugin.runs.prior.build import build_priors_for
from d2_plugin.runs.run import Run
from d2_plugin.runs.scene import Guidance, Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, prior_settings
from d2_plugin.runs.start import TimedPoints, triangulated_points

COST = Kind("time that something shared took", 1, "delete it")
"""NAME.seconds.json, beside what it is about."""

Metrics = Mapping[str, Any]
"""What metrics.json of a run holds."""


@dataclass(frozen=True, eq=False)
class Job:
    """One run of a comparison."""

    preset: str
    settings: RunSettings
    folder: Path
    guidance: Guidance | None = None
    """What guides it in place of D2's hooks."""

    @property
    def uses_prior(self) -> bool:
        """Whether hooks or another guidance read a depth prior."""
        return bool(self.settings.hooks) or self.guidance is not None

    def run(self) -> Run:
        """The run in its folder; refuses a folder of other settings, with one sentence."""
        return Run(self.settings, self.folder, self.guidance)


@dataclass(frozen=True)
class Cost:
    """What something shared took to make; None where a build was cut off, since its parts were not timed together."""

    seconds: float | None
    """Wall time."""
    cpu_seconds: float | None
    """CPU time of the process that made it; None as well where a cluster did."""

    @classmethod
    def of(cls, made: Path) -> Cost:
        """As recorded beside `made`; of nothing where there is no record."""
        record = _record(made)
        return cls(**read_table(record, COST)) if record.is_file() else cls(None, None)


@dataclass(frozen=True)
class Shared:
    """The points, and the prior of one variant, in the folder of a comparison."""

    folder: Path
    variant: str

    @property
    def points(self) -> Path:
        """The triangulated points."""
        return self.folder / "points.npz"

    @property
    def priors(self) -> Path:
        """Folder of the prior."""
        return self.folder / "priors" / self.variant

    @property
    def cost(self) -> Cost:
        """Of points and prior together."""
        parts = Cost.of(self.points), Cost.of(self.priors)
        wall, cpu = ([getattr(part, name) for part in parts] for name in ("seconds", "cpu_seconds"))
        return Cost(None if None in wall else sum(wall), None if None in cpu else sum(cpu))


def give_points(points: Path, run: Path) -> None:
    """The shared points into the folder of a run, which must exist."""
    if not (run / "points.npz").is_file():
        shutil.copyfile(points, run / "points.npz")


def share_points(settings: RunSettings, folder: Path) -> Path:
    """Triangulate where `folder` has no points.npz yet; returns its path."""
    points = folder / "points.npz"
    if not _record(points).is_file():
        scene = Scene.open(check(settings))
        _timed(points, lambda: triangulated_points(scene.recording, scene.train_cameras).save(points))
    return points


def share(settings: RunSettings, folder: Path, cluster: Mapping[str, Any] | None = None) -> Shared:
    """Make what is missing in `folder`: points.npz and priors/VARIANT.

    Args:
        settings: of any run of the comparison that uses this variant of the prior.
        folder: of the comparison, absolute.
        cluster: what builds the frames in place of this process, as for `build_priors_for`.
    """
    shared = Shared(folder, prior_settings(settings).variant)
    points = share_points(settings, folder)
    if not _record(shared.priors).is_file():
        scene = Scene.open(check(replace(settings, hooks=HOOK_NAMES)))
        positions = TimedPoints.load(points).positions
        build = lambda: build_priors_for(scene, positions, shared.priors, cluster=cluster)  # noqa: E731
        _timed(shared.priors, build, here=cluster is None)
    return shared


def _record(made: Path) -> Path:
    return Path(f"{made}.seconds.json")


def _timed(made: Path, make: Callable[[], Any], here: bool = True) -> None:
    """Make it, and record beside it what that took, where nothing of it was there before."""
    make_folder(made.parent)
    whole = not made.exists()
    start, cpu = time.monotonic(), time.process_time()
    make()
    wall, used = time.monotonic() - start, time.process_time() - cpu
    cost = {"seconds": wall if whole else None, "cpu_seconds": used if whole and here else None}
    write_table(_record(made), cost, COST)

"""What the runs of one comparison share: starting points and the full depth prior, made once."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.durable import Kind, make_folder, read_table, write_table
from d2_plugin.runs.prior.build import build_priors_for
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, prior_settings
from d2_plugin.runs.start import TimedPoints, triangulated_points

SHARED = Kind("time of a shared prior", 1, "delete it")
"""shared.json."""

FULL = "dual"
"""The variant of the prior that decides."""


@dataclass(frozen=True)
class Shared:
    """What lies in the folder of a comparison, and what it cost."""

    folder: Path
    seconds: float | None
    """Wall time of points and full prior; None where a build was cut off, since its parts were not timed together."""
    cpu_seconds: float | None
    """The same in CPU time of the process that built it."""

    @property
    def points(self) -> Path:
        """The triangulated points."""
        return self.folder / "points.npz"

    @property
    def priors(self) -> Path:
        """Folder of the full prior."""
        return self.folder / "priors" / FULL

    def give_points(self, run: Path) -> None:
        """The points into the folder of a run, which must exist."""
        if not (run / "points.npz").is_file():
            shutil.copyfile(self.points, run / "points.npz")


def share(settings: RunSettings, folder: Path, cluster: Mapping[str, Any] | None = None) -> Shared:
    """Make what is missing in `folder`: points.npz, priors/dual and shared.json.

    Args:
        settings: of any run of the comparison; its tables for the prior hold, its variant does not.
        folder: of the comparison, absolute.
        cluster: what builds the frames in place of this process, as for `build_priors_for`; no CPU time is known then.
    """
    path = folder / "shared.json"
    if path.is_file():
        return Shared(folder, **read_table(path, SHARED))
    full = check(replace(settings, hooks=HOOK_NAMES, overrides=_with(settings.overrides, "priors", variant=FULL)))
    start, cpu = time.monotonic(), time.process_time()
    scene = Scene.open(full)
    points = make_folder(folder) / "points.npz"
    if not points.is_file():
        triangulated_points(scene.recording, scene.train_cameras).save(points)
    store = folder / "priors" / FULL
    whole = not (store / "store.json").is_file()
    build_priors_for(full, scene, TimedPoints.load(points).positions, store, cluster=cluster)
    used = time.process_time() - cpu if cluster is None else None
    took = (time.monotonic() - start, used) if whole else (None, None)
    shared = Shared(folder, *took)
    write_table(path, {"seconds": took[0], "cpu_seconds": took[1]}, SHARED)
    return shared


def monocular_seconds(settings: RunSettings) -> float:
    """CPU time of the monocular maps alone: 0 for maps on disk, else one prediction, times as many as there are."""
    chosen = prior_settings(settings)
    if not chosen.mono_onnx or chosen.mono_kind is None:
        return 0.0
    from d2_plugin.priors.monocular.network import MonocularModel

    scene = Scene.open(check(settings))
    model = MonocularModel(chosen.mono_onnx, chosen.mono_kind, chosen.mono_preprocessing, chosen.mono_threads)
    image = scene.recording.image(scene.train_cameras[0], scene.recording.frames[0])
    start = time.process_time()
    model.predict(np.asarray(image))
    return (time.process_time() - start) * len(scene.train_cameras) * len(scene.recording.frames)


def _with(tables: Any, name: str, **values: Any) -> dict[str, Any]:
    """The tables with values over one of them."""
    return {**tables, name: {**tables.get(name, {}), **values}}

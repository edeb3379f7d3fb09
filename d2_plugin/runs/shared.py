"""What the runs of one comparison share: starting points and depth priors, each made once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from d2_plugin.durable import Kind, make_folder, read_table, write_table
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.priors.frame import view_digest
from d2_plugin.recordings import open_recording
from d2_plugin.runs.prior.build import build_priors_for
from d2_plugin.runs.prior.trials import can_decide, tried
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, prior_settings
from d2_plugin.runs.start import TimedPoints, triangulated_points

COST = Kind("time that something shared took", 1, "delete it")
"""NAME.seconds.json, beside what it is about, with those settings of a run that it depends on."""
OF = ("train_cameras", "frames", "downscale", "hold_out_instants")


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
    def seconds(self) -> float | None:
        """CPU seconds that points and prior took, wall seconds where a cluster built the prior; None where something
        was there that nobody timed."""
        records = [record for made in (self.points, self.priors) if (record := _record(made)).is_file()]
        parts = [read_table(record, COST)["seconds"] for record in records]
        return None if len(parts) < 2 or None in parts else sum(parts)


def share_points(settings: RunSettings, folder: Path) -> Path:
    """Triangulate where `folder` has no points.npz yet; returns its path. Those of other images are refused."""
    if (folder / "run.json").exists():
        raise D2Error(f"{folder} holds a run of `d2 train`: give another --output")
    points, of = folder / "points.npz", {name: check(settings).as_table()[name] for name in OF}
    camera = settings.train_cameras[0]
    seen = open_recording(settings.recording, cameras=[camera], frames=settings.frames, downscale=settings.downscale)
    of["recording"] = view_digest(seen, camera, seen.frames[-1])
    if not _finished(points):
        scene = Scene.open(check(settings))
        with _timed(points, of=of) as keep:
            triangulated_points(scene.recording, scene.train_cameras).save(points)
            keep()
    elif other := [name for name, kept in read_table(_record(points), COST).get("of", of).items() if kept != of[name]]:
        raise D2Error(f"{folder} holds points and priors of another {', '.join(other)}: give another --output")
    return points


def share(settings: RunSettings, folder: Path, cluster: Mapping[str, Any] | None = None) -> Shared:
    """Make what is missing in `folder`: points.npz and priors/VARIANT, with the trials of what of it helps.

    Args:
        settings: of any run of the comparison that uses this variant of the prior.
        cluster: what builds the frames in place of this process, as for `build_priors_for`.
    """
    shared = Shared(folder, prior_settings(settings).variant)
    points = share_points(settings, folder)
    if not _finished(shared.priors):
        scene, known = Scene.open(check(replace(settings, hooks=HOOK_NAMES))), TimedPoints.load(points)
        clock = time.process_time if cluster is None else time.monotonic
        with _timed(shared.priors, clock) as keep:
            summary = build_priors_for(scene, known.positions, shared.priors, cluster=cluster, on_view=keep)
            if summary.usable and can_decide(settings, scene):
                tried(settings, scene, known, shared.priors)  # counted with the runs that use it
    return shared


def _record(made: Path) -> Path:
    return Path(f"{made}.seconds.json")


def _finished(made: Path) -> bool:
    return _record(made).is_file() and "unfinished" not in read_table(_record(made), COST)


@contextmanager
def _timed(made: Path, clock: Callable[[], float] = time.process_time, **more: Any) -> Iterator[Callable[[], None]]:
    """Record beside what is made in the block how long it took to the last call of what this gives, which keeps it."""
    with only_writer(make_folder(made.parent)):  # two that share the work would each count a part of it
        record, start = _record(made), clock()
        before = read_table(record, COST)["seconds"] if record.is_file() else None if made.exists() else 0.0
        table = {"seconds": before, **more}

        def keep() -> None:
            table["seconds"] = None if before is None else before + clock() - start
            write_table(record, table | {"unfinished": True}, COST)

        keep()
        yield keep
        write_table(record, table, COST)

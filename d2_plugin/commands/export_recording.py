"""`d2 export-recording`: a recording in the input layout of another repository, with points to start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from d2_plugin.commands.arguments.recording import show_notes
from d2_plugin.protocol import EXPORT_FILE
from d2_plugin.reading import read_json
from d2_plugin.recordings import Recording, open_recording, select_cameras
from d2_plugin.recordings.export.base import unused_folder
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.runs.start import MIN_POINTS, initial_points, scene_extent, triangulated_points
from d2_plugin.settings import Count, Downscale, Positional, Range, Seed, Settings
from d2_plugin.values import counted


@dataclass(frozen=True)
class RecordingExport(Settings):
    """Which recording is written, in which layout and where."""

    recording: Annotated[Path, Positional()]
    """Folder of the recording, in any layout that d2 reads."""
    format: Literal["transforms", "n3dv", "multipleview", "colmap", "colmap_frames", "gsplat"]
    """Layout to write; docs/attach says which repository reads which."""
    output: Path
    """Folder that does not exist or is empty."""
    train_cameras: tuple[str, ...] = ()
    """Names of the cameras to train with, joined by commas; if left out, all that are not held out."""
    test_cameras: tuple[str, ...] = ()
    """Names of the cameras that are held out, joined by commas."""
    frames: tuple[Count, ...] | None = None
    """first:last or first:last:step, the last one included; if left out, all frames."""
    downscale: Downscale = 1
    """Make images this many times smaller along each side."""
    points: Annotated[int, Range(0, 10_000_000)] = MIN_POINTS
    """Least number of initial points; 0 writes none."""
    seed: Seed = 0
    """Seed of the random points among them."""


def run(settings: RecordingExport) -> str:
    """Write the recording; returns what was written and where."""
    unused_folder(settings.output)  # or say so at once
    recording = open_recording(settings.recording, frames=settings.frames, downscale=settings.downscale)
    show_notes(recording.notes)
    held_out = settings.test_cameras
    train = settings.train_cameras or tuple(name for name in recording.cameras if name not in held_out)
    recording = select_cameras(recording, [*train, *(name for name in held_out if name not in train)])
    cloud = start_cloud(recording, train, settings.points, settings.seed) if settings.points > 0 else None
    folder = export_recording(recording, settings.format, settings.output, test_cameras=held_out, cloud=cloud)
    written = read_json(folder / EXPORT_FILE, "export again")
    points = "no initial points" if cloud is None else counted(len(cloud.positions), "initial point")
    what = ", ".join([*(counted(len(written[f"{one}s"]), one) for one in ("camera", "frame")), points])
    return f"{what} in {settings.output} ({settings.format})"


def start_cloud(recording: Recording, cameras: Sequence[str], minimum: int, seed: int) -> PointCloud:
    """Points triangulated from the training cameras, filled up to `minimum` with random ones that the cameras see.

    The same start as `d2 train` has, so that another repository can be compared with the bundled backbones.
    """
    sparse = triangulated_points(recording, cameras)
    extent = scene_extent(recording, cameras, sparse.positions)
    start = initial_points(recording, cameras, sparse, extent, seed, minimum)
    return PointCloud(start.positions, start.colors, start.times)

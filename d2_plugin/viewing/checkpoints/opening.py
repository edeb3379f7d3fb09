"""A run of ours or a checkpoint of another trainer, with its recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings
from d2_plugin.reading import parsing, shown_path
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.checkpoints.clouds import newest_cloud, of_cloud
from d2_plugin.viewing.checkpoints.files import read_tensors
from d2_plugin.viewing.checkpoints.loaded import Loaded, gsplat_model
from d2_plugin.viewing.checkpoints.tuples import of_tuple
from d2_plugin.viewing.look import look
from d2_plugin.viewing.paths import pose_of
from d2_plugin.viewing.subject import Subject, subject_of_run

RUN, OUTPUT = "run.json", "point_cloud"
"""What a folder of ours has, and what that of another trainer has."""


def is_output_folder(folder: Path) -> bool:
    """Whether it is what a trainer of Inria's heirs wrote."""
    return (folder / OUTPUT).is_dir() and not (folder / RUN).exists()


@checked_arguments
def open_subject(
    path: Path, recording: Path | None = None, train_cameras: Sequence[str] | None = None, downscale: int = 1
) -> Subject:
    """A run folder, or a checkpoint of another trainer together with its recording.

    Raises:
        D2Error: one sentence for what cannot be opened, and why.
    """
    if path.is_dir() and not is_output_folder(path):
        if recording is not None or train_cameras or downscale != 1:
            raise D2Error(f"{path} is a folder of a run, which knows its recording: leave out what is for checkpoints")
        return subject_of_run(path)
    return open_checkpoint(path, recording, train_cameras, downscale)[0]


@checked_arguments
def open_checkpoint(
    path: Path, recording: Path | None = None, train_cameras: Sequence[str] | None = None, downscale: int = 1
) -> tuple[Subject, Loaded]:
    """What another trainer wrote, with its recording, and what its file says beside.

    Raises:
        D2Error: one sentence for what cannot be opened, and why.
    """
    if is_output_folder(path):
        path = newest_cloud(path)
    if not path.is_file():
        raise D2Error(f"no run at {path}: give the --output folder of `d2 train`, or a trainer's checkpoint")
    if recording is None:
        raise D2Error(f"{path.name} does not say where its cameras stood: name its recording with --recording")
    opened = open_recording(recording, downscale=downscale)
    with parsing(f"checkpoint {shown_path(path)}", "give one of the trainers that docs/see.md names"):
        loaded = _loaded(path, opened)
    names = tuple(opened.cameras)
    for name in train_cameras or ():
        opened.image(name, opened.frames[0])  # an unknown name is refused there
    trained = tuple(train_cameras) if train_cameras else names
    held_out = tuple(name for name in names if name not in trained)
    if not len(loaded.backbone):
        raise D2Error(f"{path} has no Gaussian: nothing can be shown")
    found = Subject(path.stem, opened, trained, held_out, loaded.backbone, note=loaded.note)
    found = replace(found, time_scale=loaded.time_scale)
    _try(found, path)
    return found, loaded


def _try(subject: Subject, path: Path) -> None:
    """Look once at what a file of somebody else's holds, so that what does not fit together is said now."""
    view = subject.view(pose_of(next(iter(subject.recording.cameras.values()))), 0.0, (16, 16))
    with parsing(f"checkpoint {shown_path(path)}", "give one whose tensors fit together"):
        shown = look(subject.backbone, view).splats
    if not all(bool(torch.isfinite(part).all()) for part in (shown.means, shown.covariances, shown.opacities)):
        raise D2Error(f"{path} has numbers that are not finite: its training diverged, give an earlier checkpoint")


def _loaded(path: Path, recording: Recording) -> Loaded:
    if path.suffix == ".ply":
        return of_cloud(path, recording)
    stored = read_tensors(path)
    if isinstance(stored, dict) and "splats" in stored:
        return gsplat_model(stored["splats"], RasterSettings(near=0.01), "gsplat's Gaussians stand still")
    if isinstance(stored, (tuple, list)) and len(stored) == 2 and isinstance(stored[0], (tuple, list)):
        return of_tuple(stored[0], path, recording)
    raise D2Error(
        f"{path} is no checkpoint that can be shown: have those of fudan, 4C4D, 4DGaussians, 3D Gaussian Splatting and "
        "gsplat, and point clouds (.ply); inside another trainer, Viewer(d2) shows the model as it trains"
    )

"""A run of ours or a checkpoint of another trainer, with its recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, shown_path
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.checkpoints.files import read_tensors
from d2_plugin.viewing.checkpoints.models import Checkpoint, newest_cloud, of_cloud, of_tuple
from d2_plugin.viewing.rendering import render_view
from d2_plugin.viewing.viewed import ViewedRun, viewed_run


def is_output_folder(folder: Path) -> bool:
    """Whether it is what a trainer of Inria's heirs wrote."""
    return (folder / "point_cloud").is_dir() and not (folder / "run.json").exists()


@checked_arguments
def open_viewed(
    path: Path, recording: Path | None = None, train_cameras: Sequence[str] | None = None, downscale: int = 1
) -> ViewedRun:
    """A run folder, or what another trainer wrote, together with its recording.

    Raises:
        D2Error: one sentence for what cannot be opened, and why.
    """
    if path.is_dir() and not is_output_folder(path):
        if recording is not None or train_cameras or downscale != 1:
            raise D2Error(f"{path} is a folder of a run, which knows its recording: leave out what is for checkpoints")
        return viewed_run(path)
    if is_output_folder(path):
        path = newest_cloud(path)
    if not path.is_file():
        raise D2Error(f"no run at {path}: give the --output folder of `d2 train`, or a trainer's checkpoint")
    if recording is None:
        raise D2Error(f"{path.name} does not say where its cameras stood: name its recording with --recording")
    opened = open_recording(recording, downscale=downscale)
    with parsing(f"checkpoint {shown_path(path)}", "give one of the trainers that docs/see.md names"):
        checkpoint = _checkpoint(path, opened)
    for name in train_cameras or ():
        opened.image(name, opened.frames[0])  # an unknown name is refused there
    trained = tuple(train_cameras or opened.cameras)
    held_out = tuple(name for name in opened.cameras if name not in trained)
    if not len(checkpoint.backbone):
        raise D2Error(f"{path} has no Gaussian: nothing can be shown")
    viewed = ViewedRun(path.stem, opened, trained, held_out, **checkpoint._asdict())
    # One small image is drawn of somebody else's file, so that what does not fit together is an error now.
    view = viewed.view(next(iter(viewed.recording.cameras.values())), 0.0, (16, 16))
    with parsing(f"checkpoint {shown_path(path)}", "give one whose tensors fit together"):
        shown = render_view(viewed.backbone, view).splats
    if not all(bool(torch.isfinite(part).all()) for part in (shown.means, shown.covariances, shown.opacities)):
        raise D2Error(f"{path} has numbers that are not finite: its training diverged, give an earlier checkpoint")
    return viewed


def _checkpoint(path: Path, recording: Recording) -> Checkpoint:
    if path.suffix == ".ply":
        return of_cloud(path, recording)
    stored = read_tensors(path)
    if isinstance(stored, (tuple, list)) and len(stored) == 2 and isinstance(stored[0], (tuple, list)):
        return of_tuple(stored[0], path, recording)
    raise D2Error(
        f"{path} is no checkpoint that can be shown: have those of fudan, 4C4D, 4DGaussians and 3D Gaussian "
        "Splatting, and point clouds (.ply); inside another trainer, Viewer(d2) shows the model as it trains"
    )

"""What is looked at: Gaussians with the recording they belong to, its cameras and its depth prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.priors.frame import describe_recording
from d2_plugin.protocol import View
from d2_plugin.recordings import Camera, Recording, Source
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import load_checkpoint, read_metrics
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore, other_recording
from d2_plugin.viewing.camera_paths import for_size

UNKNOWN_IMAGE = 60
"""Grey of an image that was not kept."""


@dataclass(frozen=True, eq=False)
class ViewedRun:
    """One set of Gaussians, or none yet, and what belongs to it."""

    name: str
    recording: Recording
    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...] = ()
    backbone: Any = None
    """A `d2_plugin.protocol.Backbone`; None where there is only a recording or a prior."""
    store: PriorStore | None = None
    inserted_at: Tensor | None = None
    """Per Gaussian [N], the step at which D2 inserted it, 0 for the others; None where that is not known."""
    points: np.ndarray | None = None
    """Triangulated surface points [P, 3]."""
    device: str = "cpu"
    scores: Mapping[str, float] = field(default_factory=dict)
    """PSNR of each scored camera, and under "" that of all held-out ones, as far as it is known."""
    note: str = ""
    """What a person should know about it, in one sentence."""
    background_weight: float = 1.0
    """Photometric weight of pixels outside the recording's foreground masks, as the run trained."""
    time_scale: float = 1.0
    """The trainer's unit of time, per second."""
    time_offset: float = 0.0
    """The trainer's time at the first frame."""
    harmonics: Harmonics | None = None
    """Colours of a checkpoint; None where only the backbone knows them, for one direction after the other."""
    moving: MovingGaussians | None = None
    """A checkpoint's Gaussians as straight lines that fade, in seconds since the first frame, where they are such."""

    @property
    def training(self) -> list[Camera]:
        """The cameras that train."""
        return [self.recording.cameras[name] for name in self.train_cameras]

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return self.recording.seconds(self.recording.frames[-1])

    def frame_at(self, time: float, camera: str | None = None) -> int:
        """The recorded frame, as `camera` took it, that is nearest to an instant, in seconds."""
        return min(self.recording.frames, key=lambda frame: abs(self.recording.seconds(frame, camera) - time))

    def view(self, camera: Camera, time: float, size: tuple[int, int] | None = None) -> View:
        """What a camera sees at an instant, in its own size or another; it has a name if it is one of the recording."""
        camera = camera if size is None else for_size(camera, *size)
        T, K = (torch.tensor(m, dtype=torch.float32, device=self.device) for m in (camera.T_camera_world, camera.K))
        moment = self.frame_at(time, camera.name), self.time_offset + time * self.time_scale
        return View(camera.name, *moment, T, K, camera.width, camera.height)

    @property
    def depth(self) -> float | None:
        """Median depth of the triangulated points in front of the first training camera; None where unknown."""
        if self.points is None or not len(self.points):
            return None
        T = self.training[0].T_camera_world
        z = self.points @ T[2, :3] + T[2, 3]
        return float(np.median(z[z > 0])) if (z > 0).any() else None


def viewed_run(folder: Path) -> ViewedRun:
    """A run of `d2 train` at its last checkpoint; one that still trains is shown as far as it is.

    Raises:
        D2Error: no run, one of another version, no checkpoint yet, or no Gaussian left.
    """
    run = Run.load(folder)
    trained, total = run.trained(), run.settings.iterations
    if not len(trained.model):
        raise D2Error(f"{folder} has no Gaussian left at step {trained.step}: nothing can be shown, train it anew")
    hooks = (load_checkpoint(folder / "checkpoint.pt", "cpu") or {}).get("d2") or {}
    note = (
        "" if trained.step >= total else f"{folder.resolve().name} still trains: this is step {trained.step} of {total}"
    )
    adapter: Any = registry.load(registry.ADAPTERS, run.settings.backbone)
    scores: dict[str, float] = {}
    if (folder / "metrics.json").is_file() and (table := read_metrics(folder))["test"] is not None:
        scores = {"": table["test"]["psnr"]} | {row["camera"]: row["psnr"] for row in table["per_camera"]}
    return replace(_of_run(run, adapter(trained.model), hooks.get("inserted_at")), note=note, scores=scores)


def viewed_training(run: Run, trainer: Any) -> ViewedRun:
    """A run while it trains."""
    if trainer.d2 is not None:
        return _of_run(run, trainer.d2.backbone, trainer.d2.inserted_at)
    adapter: Any = registry.load(registry.ADAPTERS, run.settings.backbone)
    return _of_run(run, adapter(trainer.model), None)


def _of_run(run: Run, backbone: Any, inserted_at: Tensor | None) -> ViewedRun:
    path = run.folder / "points.npz"
    return ViewedRun(
        run.folder.resolve().name,
        run.scene.recording,
        run.scene.train_cameras,
        run.scene.test_cameras,
        backbone,
        PriorStore.open(run.priors) if (run.priors / "store.json").is_file() else None,
        inserted_at,
        TimedPoints.load(path).positions if path.is_file() else None,
        run.settings.device,
        background_weight=run.settings.background_weight,
    )


def viewed_recording(recording: Recording, priors: Path | None = None) -> ViewedRun:
    """A recording alone, or with the depth prior in `priors`, whose cameras are then the training cameras."""
    if priors is None:
        return ViewedRun(recording.name, recording, tuple(recording.cameras))
    store = PriorStore.open(priors)
    unknown = [camera for camera in store.cameras if camera not in recording.cameras]
    if unknown:
        raise D2Error(
            f"{priors} has priors of camera {unknown[0]}, which {recording.name} does not have: "
            "give the recording that they were built for"
        )
    if why := other_recording(store.about, describe_recording(recording)):
        raise D2Error(f"{priors} is no prior of {recording.name} ({why}): give its recording and its --downscale")
    return ViewedRun(recording.name, recording, store.cameras, store=store)


def viewed_views(views: Sequence[View], backbone: Any, store: Any, name: str) -> ViewedRun:
    """The cameras that a trainer has used so far; its times are taken to grow evenly from frame to frame."""
    cameras = {}
    for view in views:
        K, T = (tensor.detach().double().cpu().numpy() for tensor in (view.K, view.T_camera_world))
        cameras[view.camera] = Camera(view.camera, view.width, view.height, K, T)
    times = {view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    first, last = times[frames[0]], times[frames[-1]]
    fps = (frames[-1] - frames[0]) / (last - first) if last > first else 1.0
    recording = Recording(name, cameras, frames, fps, KeptImages(cameras, store))
    kept = store if isinstance(store, PriorStore) else None
    device = str(views[0].T_camera_world.device)
    return ViewedRun(name, recording, tuple(cameras), (), backbone, kept, device=device, time_offset=first)


@dataclass(frozen=True)
class KeptImages(Source):
    """Where no recording is at hand: images as the depth prior kept them, grey where there is none."""

    cameras: dict[str, Camera]
    store: Any = None
    """Anything with `prior(camera, frame) -> DepthPrior | None`."""

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        size = self.cameras[camera].height, self.cameras[camera].width, 3
        prior = None
        with suppress(D2Error):  # a camera that has no prior
            prior = None if self.store is None else self.store.prior(camera, frame)
        colors = None if prior is None or prior.colors is None else prior.colors.cpu().numpy()
        return colors if colors is not None and colors.shape == size else np.full(size, UNKNOWN_IMAGE, np.uint8)

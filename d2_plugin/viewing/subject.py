"""What is looked at: Gaussians with the recording they belong to, its cameras, and its depth prior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.protocol import View
from d2_plugin.recordings import Camera, Recording
from d2_plugin.runs.run import Run
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.paths import Lens, Pose


@dataclass(frozen=True, eq=False)
class Subject:
    """One set of Gaussians, or none yet, and what belongs to it."""

    name: str
    recording: Recording
    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...] = ()
    backbone: Any = None
    """A `d2_plugin.protocol.Backbone`; None where there is only a recording or a prior."""
    store: PriorStore | None = None
    inserted_at: Tensor | None = None
    """Per Gaussian [N], the step at which D2 inserted it, 0 for the others; None where nobody knows."""
    points: np.ndarray | None = None
    """Triangulated surface points [P, 3]."""
    device: str = "cpu"
    note: str = ""
    """What a person should know about it, in one sentence."""
    time_scale: float = 1.0
    """The trainer's unit of time, per second."""
    time_offset: float = 0.0
    """The trainer's time at the first frame."""

    @property
    def training(self) -> list[Camera]:
        """The cameras that train."""
        return [self.recording.cameras[name] for name in self.train_cameras]

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return self.recording.seconds(self.recording.frames[-1])

    def frame_at(self, time: float) -> int:
        """The recorded frame that is nearest to an instant, in seconds."""
        return min(self.recording.frames, key=lambda frame: abs(self.recording.seconds(frame) - time))

    def view(self, pose: Pose, time: float, size: tuple[int, int], camera: str = "") -> View:
        """The view of a pose at an instant; `camera` names the camera of the recording that it is, if it is one."""
        lens = pose.lens.fitted(*size)
        T = torch.tensor(pose.T_camera_world, dtype=torch.float32, device=self.device)
        K = torch.tensor(lens.K, dtype=torch.float32, device=self.device)
        return View(camera, self.frame_at(time), self.time_offset + time * self.time_scale, T, K, *size)

    @property
    def depth(self) -> float | None:
        """Median depth of the triangulated points in front of the first training camera; None where unknown."""
        if self.points is None or not len(self.points):
            return None
        T = self.training[0].T_camera_world
        z = self.points @ T[2, :3] + T[2, 3]
        return float(np.median(z[z > 0])) if (z > 0).any() else None


def subject_of_run(folder: Path) -> Subject:
    """A run of `d2 train` at its last checkpoint; one that still trains is shown as far as it is.

    Raises:
        D2Error: no run, one of another version, no checkpoint yet, or no Gaussian left.
    """
    run = Run.load(folder)
    trained = run.trained()
    if not len(trained.model):
        raise D2Error(f"{folder} has no Gaussian left at step {trained.step}: nothing can be shown, train it anew")
    points = folder / "points.npz"
    adapter: Any = registry.load(registry.ADAPTERS, run.settings.backbone)
    total = run.settings.iterations
    note = "" if trained.step >= total else f"{folder.name} still trains: this is step {trained.step} of {total}"
    return Subject(
        folder.name,
        run.scene.recording,
        run.scene.train_cameras,
        run.scene.test_cameras,
        adapter(trained.model),
        PriorStore.open(run.priors) if (run.priors / "store.json").is_file() else None,
        _inserted_at(folder / "checkpoint.pt", len(trained.model)),
        TimedPoints.load(points).positions if points.is_file() else None,
        run.settings.device,
        note,
    )


def _inserted_at(checkpoint: Path, count: int) -> Tensor | None:
    """From the state of D2 in a checkpoint; None where no hook ran, or an older version wrote it."""
    hooks = torch.load(checkpoint, map_location="cpu", weights_only=True)["d2"] or {}
    found = hooks.get("inserted_at")
    return found if found is not None and len(found) == count else None


def subject_of_recording(recording: Recording) -> Subject:
    """A recording alone."""
    return Subject(recording.name, recording, tuple(recording.cameras))


def with_priors(subject: Subject, folder: Path) -> Subject:
    """The same with the depth prior in `folder`, whose cameras are the training cameras."""
    store = PriorStore.open(folder)
    unknown = [camera for camera in store.cameras if camera not in subject.recording.cameras]
    if unknown:
        raise D2Error(
            f"{folder} has priors of camera {unknown[0]}, which {subject.recording.name} does not have: "
            "give the recording that they were built for"
        )
    return replace(subject, store=store, train_cameras=store.cameras)


def size_of(lens: Lens, width: int | None, height: int | None) -> tuple[int, int]:
    """The size of an image: as given, the other side in proportion, by default the lens's own."""
    if width is None and height is None:
        return lens.width, lens.height
    if height is None:
        return int(width or 1), max(round(lens.height * (width or 1) / lens.width), 1)
    return (max(round(lens.width * height / lens.height), 1) if width is None else width), height

"""`d2 train --view`: the page of a run while it trains, with its score so far."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import Any

import torch

from d2_plugin import registry
from d2_plugin.runs.metrics import psnr
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved.finite import OnStep
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.live.pace import Share
from d2_plugin.viewing.live.viewer import Viewer
from d2_plugin.viewing.look import look
from d2_plugin.viewing.paths import pose_of
from d2_plugin.viewing.subject import Subject

SCORED = 0.02
"""Share of a training's time that its score so far may take, while somebody looks."""
AVERAGED = 16
"""The score so far is the mean over this many of the last views."""


class LiveRun:
    """A run that is watched: give `watch` to `Run.train`."""

    def __init__(self, run: Run, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.run, self.host, self.port = run, host, port
        self.viewer: Viewer | None = None

    def watch(self, trainer: Any) -> OnStep:
        """Open the page once there is a model; returns what is called after every step."""
        subject = subject_of_training(self.run, trainer)
        iterations = self.run.settings.iterations
        self.viewer = viewer = Viewer(subject=subject, host=self.host, port=self.port, iterations=iterations)
        scorer = Scorer(subject)
        if trainer.d2 is not None:
            viewer.marks = lambda: trainer.d2.inserted_at
        sys.stdout.write(f"watch it train at {viewer.url}\n")
        sys.stdout.flush()

        def on_step(step: int, loss: float) -> None:
            if viewer.clients and (said := scorer.score()) is not None:
                viewer.score(said)
            viewer.after_step(step, loss)

        return on_step

    def stay(self) -> None:
        """After the training: as long as somebody looks."""
        if self.viewer is None:
            return
        viewer = self.viewer
        try:
            if viewer.clients:
                sys.stdout.write(f"{viewer.url} stays until its last page is closed, or Ctrl-C\n")
                sys.stdout.flush()
            viewer.stay(lambda: not viewer.clients)
        except KeyboardInterrupt:
            pass
        finally:
            viewer.close()


class Scorer:
    """PSNR of the held-out views so far: one view after the other, as far as its share of the time allows."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        names = subject.test_cameras or subject.train_cameras
        self._views = [(name, frame) for frame in subject.recording.frames for name in names]
        self._scores: deque[float] = deque(maxlen=min(AVERAGED, len(self._views)))
        self._next, self._share, self._last = 0, Share(SCORED), time.monotonic()

    def score(self) -> str | None:
        """The score so far, where there was time for another view."""
        now = time.monotonic()
        self._share.passes(now - self._last)
        self._last = now
        if not self._share.due:
            return None
        # Steps that share no factor with the number of views visit all of them, spread over the recording.
        name, frame = self._views[self._next * 7919 % len(self._views)]
        self._next += 1
        camera = self.subject.recording.cameras[name]
        size = camera.width, camera.height
        view = self.subject.view(pose_of(camera), self.subject.recording.seconds(frame), size, name)
        truth = torch.from_numpy(self.subject.recording.image(name, frame)).float() / 255
        self._scores.append(psnr(look(self.subject.backbone, view).color, truth))
        self._share.spend(time.monotonic() - now)
        kind = "held-out" if self.subject.test_cameras else "training"
        mean = sum(self._scores) / len(self._scores)
        return f"{mean:.2f} dB PSNR, {kind}, last {len(self._scores)} views"


def subject_of_training(run: Run, trainer: Any) -> Subject:
    """A run while it trains."""
    adapter: Any = registry.load(registry.ADAPTERS, run.settings.backbone)
    d2, scene = trainer.d2, run.scene
    path = run.folder / "points.npz"
    points = TimedPoints.load(path) if path.is_file() else None
    return Subject(
        run.folder.name,
        scene.recording,
        scene.train_cameras,
        scene.test_cameras,
        adapter(trainer.model) if d2 is None else d2.backbone,
        PriorStore.open(run.priors) if (run.priors / "store.json").is_file() else None,
        None if d2 is None else d2.inserted_at,
        None if points is None else points.positions,
        run.settings.device,
    )

"""`d2 view` and `d2 train --view`: what to show, for how long, and the score of a training so far."""

from __future__ import annotations

import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch

from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording
from d2_plugin.runs.metrics import psnr
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import OnStep
from d2_plugin.settings import Downscale, Positional, Range, Settings
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.camera_paths import pose_of
from d2_plugin.viewing.checkpoints import is_output_folder, open_viewed
from d2_plugin.viewing.live.images import Share
from d2_plugin.viewing.live.server import LOCAL
from d2_plugin.viewing.live.viewer import Viewer
from d2_plugin.viewing.rendering import render_view
from d2_plugin.viewing.viewed import ViewedRun, viewed_recording, viewed_store, viewed_training

SCORED = 0.02
"""Share of a training's time that its score so far may take, while somebody looks."""
AVERAGED = 16
"""The score so far is the mean over this many of the last views."""


@dataclass(frozen=True)
class ViewSettings(Settings):
    """What is shown, and who may look."""

    shown: Annotated[Path, Positional()]
    """Folder of a run, a recording or a depth prior; or what an official trainer wrote, with --recording."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone, and 0.0.0.0 is every network that it is in."""
    port: Annotated[int, Range(1, 65535)] = 8080
    """Port of the page; the next free one where it is in use."""
    height: Annotated[int, Range(16, 4096, unit="pixels")] = 360
    """Height of an image at rest; while something moves it is as small as it must be."""
    recording: Path | None = None
    """The recording of a prior or of a checkpoint."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with."""
    downscale: Downscale = 1
    """Make the recording's images this many times smaller."""


def run(settings: ViewSettings) -> str:
    """Show it until Ctrl-C."""
    viewed = viewed_at(settings)
    viewer = Viewer(viewed=viewed, host=settings.host, port=settings.port, height=settings.height)
    notes = [viewed.note] if viewed.note else []
    sys.stdout.write("".join(f"     note  {note}\n" for note in notes) + f"{address_line(viewer, settings.host)}\n")
    sys.stdout.flush()
    try:
        viewer.stay()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return "closed"


def viewed_at(settings: ViewSettings) -> ViewedRun:
    """What lies at the path: a prior store, a run, a checkpoint, or else a recording.

    Raises:
        D2Error: one sentence for what is none of these.
    """
    path = settings.shown
    if (path / "store.json").is_file():
        if settings.recording is None:
            return viewed_store(PriorStore.open(path))
        return viewed_recording(open_recording(settings.recording, downscale=settings.downscale), path)
    if path.is_file() or (path / "run.json").is_file() or is_output_folder(path):
        return open_viewed(path, settings.recording, settings.train_cameras, settings.downscale)
    if path.is_dir() and not any(path.iterdir()):
        raise D2Error(f"{path} is empty: give the folder of a run, a recording or a depth prior")
    return viewed_recording(open_recording(path, downscale=settings.downscale))


def address_line(viewer: Viewer, host: str) -> str:
    """Where the page is, and who can see it."""
    who = "" if host in LOCAL else "; everybody who has this address can see it and move in it"
    return f"{viewer.url}  (Ctrl-C ends){who}"


class LiveRun:
    """A run that is watched: give `watch` to `Run.train`."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.viewer: Viewer | None = None

    def watch(self, trainer: Any) -> OnStep:
        """Open the page once there is a model; returns what is called after every step."""
        viewed = viewed_training(self.run, trainer)
        iterations = self.run.settings.iterations
        self.viewer = viewer = Viewer(viewed=viewed, iterations=iterations)
        scorer = Scorer(viewed)
        if trainer.d2 is not None:
            viewer.marks = lambda: trainer.d2.inserted_at
        sys.stdout.write(f"watch it train at {viewer.url}\n")
        sys.stdout.flush()

        def on_step(step: int, loss: float) -> None:
            if viewer.clients and (score := scorer.score()) is not None:
                viewer.set_score(score)
            viewer.after_step(step, loss)

        return on_step

    def stay(self) -> None:
        """After the training: as long as a page is open."""
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

    def __init__(self, viewed: ViewedRun) -> None:
        self.viewed = viewed
        names = viewed.test_cameras or viewed.train_cameras
        self._views = [(name, frame) for frame in viewed.recording.frames for name in names]
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
        camera = self.viewed.recording.cameras[name]
        size = camera.width, camera.height
        view = self.viewed.view(pose_of(camera), self.viewed.recording.seconds(frame), size, name)
        truth = torch.from_numpy(self.viewed.recording.image(name, frame)).float() / 255
        self._scores.append(psnr(render_view(self.viewed.backbone, view).color, truth))
        self._share.spend(time.monotonic() - now)
        kind = "held-out" if self.viewed.test_cameras else "training"
        mean = sum(self._scores) / len(self._scores)
        return f"{mean:.2f} dB PSNR, {kind}, last {len(self._scores)} views"

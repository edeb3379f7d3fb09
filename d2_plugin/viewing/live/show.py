"""`d2 view` and `d2 train --view`: what to show, for how long, and the score of a training so far."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch

from d2_plugin.errors import D2Error
from d2_plugin.progress import show
from d2_plugin.recordings import open_recording
from d2_plugin.runs.evaluation import what_counts
from d2_plugin.runs.metrics import psnr
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import OnStep
from d2_plugin.settings import Downscale, Positional, Range, Settings
from d2_plugin.values import counted
from d2_plugin.viewing.checkpoints import is_output_folder, open_viewed
from d2_plugin.viewing.live.images import Share
from d2_plugin.viewing.live.server import LOCAL
from d2_plugin.viewing.live.viewer import Viewer
from d2_plugin.viewing.panels import Shot
from d2_plugin.viewing.viewed import ViewedRun, viewed_recording, viewed_training

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
    show(*([f"     note  {viewed.note}"] if viewed.note else []), address_line(viewer, settings.host))
    with closing(viewer), suppress(KeyboardInterrupt):
        viewer.stay()
    return "closed"


def viewed_at(settings: ViewSettings) -> ViewedRun:
    """What lies at the path: a prior store, a run, a checkpoint, or else a recording.

    Raises:
        D2Error: one sentence for what is none of these.
    """
    path = settings.shown
    if (path / "store.json").is_file():
        if settings.recording is not None:
            return viewed_recording(open_recording(settings.recording, downscale=settings.downscale), path)
        if not (path.parent / "run.json").is_file():
            raise D2Error(f"{path} lies in no folder of a run: name its recording with --recording")
        return viewed_recording(Run.load(path.parent).scene.recording, path)
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
        scores = _scores(viewed)
        if trainer.d2 is not None:
            viewer.marks = lambda: trainer.d2.inserted_at
        show(f"watch it train at {viewer.url}")

        def on_step(step: int, loss: float) -> None:
            if viewer.clients and (score := next(scores)) is not None:
                viewer.set_score(score)
            viewer.after_step(step, loss)

        return on_step

    def stay(self) -> None:
        """After the training: as long as a page is open."""
        if self.viewer is None:
            return
        with closing(self.viewer) as viewer, suppress(KeyboardInterrupt):
            if viewer.clients:
                show(f"{viewer.url} stays until its last page is closed, or Ctrl-C")
            viewer.stay(lambda: not viewer.clients)


def _scores(viewed: ViewedRun) -> Iterator[str | None]:
    """PSNR of the held-out views so far, one view after the other; None where its share of the time allows no more."""
    recording, share, last = viewed.recording, Share(SCORED), time.monotonic()
    kind, names = ("held-out", viewed.test_cameras) if viewed.test_cameras else ("training", viewed.train_cameras)
    views = [(name, frame) for frame in recording.frames for name in names]
    scores: deque[float] = deque(maxlen=min(AVERAGED, len(views)))
    for number in itertools.count():
        # Steps that share no factor with the number of views visit all of them, spread over the recording.
        name, frame = views[number * 7919 % len(views)]
        while True:
            now = time.monotonic()
            share.passes(now - last)
            last = now
            if share.due:
                break
            yield None
        shot = Shot(viewed, viewed.view(recording.cameras[name], recording.seconds(frame, name)))
        counts = what_counts(recording, name)
        scores.append(psnr(shot.rendered.color, torch.from_numpy(shot.truth).float() / 255, counts))
        share.spent += time.monotonic() - now
        yield f"{sum(scores) / len(scores):.2f} dB PSNR, {kind}, last {counted(len(scores), 'view')}"

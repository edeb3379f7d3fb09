"""The depth prior built in step with training: by a process of its own, while this one trains on what is finished.

Frames join the training by its steps and not by the clock, so a run is the same bits however long its prior takes: a
trainer that is ahead waits. Where the trainer of a backbone draws its views without asking, it waits for their frames
all the same. At most the time of the first fifth of the steps is saved, and only where a recording has more frames than
one block; late frames are seen less often, which costs quality of what moves (docs/evidence.md).
"""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.summary import PriorSummary
from d2_plugin.progress import be_silent, progress_bar
from d2_plugin.runs.prior.build import build_priors_for
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.workers import end_with_parent

FIRST = 0.25
"""Share of the frames that training begins with."""
MOST_FIRST = 30
"""At most so many: a block of frames that are matched one after the other (`StereoSettings.reuse_block`)."""
OPEN_BY = 0.2
"""Share of the steps by which all frames have joined."""


def frames_open(step: int, iterations: int, frames: int) -> int:
    """How many of the frames, from the first on, are trained on at `step` (from 1) of `iterations`."""
    if step >= OPEN_BY * iterations:
        return frames
    first = min(math.ceil(FIRST * frames), MOST_FIRST)
    return first + math.floor((step - 1) / (OPEN_BY * iterations) * (frames - first))


class PriorAlongside:
    """A process that builds the depth prior of a run, frame after frame.

    Started from a script of your own it imports that script: put the call under `if __name__ == "__main__":`.

    Args:
        settings, scene: of the run.
        folder: of the store, which others may read meanwhile.
        points: triangulated points [P, 3], as for `build_priors_for`.
    """

    def __init__(self, settings: RunSettings, scene: Scene, folder: Path, points: np.ndarray) -> None:
        self.cameras, self.frames = len(scene.train_cameras), scene.recording.frames
        self.iterations = settings.iterations
        self.seconds = self.cpu_seconds = 0.0
        """What the build took, once it is finished."""
        self._summary: PriorSummary | None = None
        self._images, self._start = 0, time.monotonic()
        context = multiprocessing.get_context("spawn")
        self._progress, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_build, args=(sender, settings, points, folder), daemon=True)
        self._process.start()
        sender.close()  # the other process has it: its end is the end of the pipe

    def opened(self, step: int) -> int:
        """How many views, frame by frame, are trained on at a step; returns once their prior is there."""
        while self._summary is None and self._progress.poll():  # the sender must not wait for this process
            self._receive()
        count = frames_open(step, self.iterations, len(self.frames))
        self.wait(count)
        return count * self.cameras

    def wait_for(self, frame: int) -> None:
        """Return once the prior of a frame is there."""
        self.wait(self.frames.index(frame) + 1)

    def wait(self, frames: int, on_images: Callable[[int], None] | None = None) -> None:
        """Return once the prior of so many frames is there; `on_images` is called with those that are done.

        Raises:
            D2Error: what the build refuses, or its process was killed.
        """
        while self._images < frames * self.cameras and self._summary is None:
            self._receive()
            if on_images is not None:
                on_images(min(self._images, frames * self.cameras))

    @property
    def share(self) -> float:
        """How much of the prior is known to be there."""
        return 1.0 if self._summary is not None else self._images / (self.cameras * len(self.frames))

    def finish(self) -> PriorSummary:
        """What the prior became, once all of it is there.

        Raises:
            D2Error: what the build refuses, or its process was killed.
        """
        while self._summary is None:
            self._receive()
        return self._summary

    def end(self) -> None:
        """End the process; the frames that it finished stay."""
        self._process.terminate()
        self._process.join()

    def _receive(self) -> None:
        try:
            message = self._progress.recv()
        except EOFError:
            self._process.join()
            raise D2Error(
                f"the process that builds the prior ended with code {self._process.exitcode}: the same command goes "
                "on where it stopped, and without --priors-in-step it builds the prior first"
            ) from None
        if isinstance(message, int):
            self._images = message
        elif isinstance(message, str):
            raise D2Error(message)
        else:
            self._summary, self.cpu_seconds = message
            self.seconds = time.monotonic() - self._start


def _build(sender: Connection, settings: RunSettings, points: np.ndarray, folder: Path) -> None:
    """The work of the process: it sends how many images are done, at last the summary or why there is none."""
    end_with_parent()
    be_silent()
    try:
        between = "motion" in settings.hooks
        summary = build_priors_for(Scene.open(settings), points, folder, on_image=sender.send, between=between)
    except D2Error as refusal:
        sender.send(str(refusal))
    else:
        sender.send((summary, time.process_time()))


@contextmanager
def alongside(settings: RunSettings, scene: Scene, folder: Path, points: np.ndarray) -> Iterator[PriorAlongside]:
    """A `PriorAlongside` that has finished its first frames, and ends with the block."""
    building = PriorAlongside(settings, scene, folder, points)
    first = frames_open(1, settings.iterations, len(scene.recording.frames))
    try:
        with progress_bar("priors of the first frames", first * building.cameras) as bar:
            building.wait(first, bar.update)
        yield building
    finally:
        building.end()

"""Exports and priors that the trials share: made once in the working folder, used again by every run."""

import logging
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.trainers.moving import save_truth
from benchmarks.trainers.trials import HELD_OUT, TRAINED, Trial
from d2_plugin.commands.export_recording import RecordingExport
from d2_plugin.commands.export_recording import run as export
from d2_plugin.errors import D2Error
from d2_plugin.protocol import EXPORT_FILE
from d2_plugin.recordings import open_recording

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """What of a recording is trained on."""

    recording: Path
    frames: int
    """How many, from the first."""
    downscale: int
    step: int = 1
    """From one of them to the next."""

    @property
    def name(self) -> str:
        """For folders of the working folder."""
        return f"{self.recording.name}-{self.frames}-{self.downscale}" + (f"-{self.step}" if self.step > 1 else "")

    @property
    def seconds(self) -> float:
        """Length of the clip: one frame more than its last begins."""
        opened = open_recording(self.recording)
        return self.frames * self.step / opened.fps

    @property
    def numbers(self) -> range:
        """Of the frames."""
        return range(0, self.frames * self.step, self.step)


@dataclass(frozen=True)
class Prepared:
    """One recording as one trainer reads it."""

    source: Source
    data: Path
    held_out: Path | None
    """A second export, of the cameras that are not trained on, for a repository that has no other way to test."""
    prior: Path
    truth: Path
    """What `moving.save_truth` wrote."""


def prepare(source: Source, trial: Trial, work: Path) -> Prepared:
    """Export the recording in the trainer's layout and build its prior, where they are not there yet."""
    source = replace(source, downscale=fitting_downscale(source.recording, trial, source.downscale))
    named = f"{source.name}-{trial.layout}-{len(trial.held_out)}-{trial.points}"
    data = _exported(source, trial, work / "exports" / named, TRAINED, trial.held_out)
    held_out = None
    if trial.also_held_out:
        held_out = _exported(source, trial, work / "exports" / f"{named}-held-out", HELD_OUT, ())
    truth = work / f"truth-{source.name}.npz"
    if not truth.is_file():
        save_truth(source.recording, source.numbers, source.downscale, truth)
    return Prepared(source, data, held_out, _prior(source, work / "priors" / source.name), truth.resolve())


def fitting_downscale(recording: Path, trial: Trial, downscale: int) -> int:
    """`downscale`, or the largest below it at which the trainer's report can be measured."""
    if trial.least_side == 1:
        return downscale
    sides = [min(camera.width, camera.height) for camera in open_recording(recording).cameras.values()]
    fitting = [factor for factor in range(1, downscale + 1) if min(sides) // factor >= trial.least_side]
    if not fitting:
        raise D2Error(
            f"{recording} has images of {min(sides)} pixels along a side, and the report of {trial.folder} needs "
            f"{trial.least_side}: leave it out with --only, or give a larger recording"
        )
    if fitting[-1] != downscale:
        log.info("%s is made %d times smaller, not %d times: see Trial.least_side", recording, fitting[-1], downscale)
    return fitting[-1]


def _exported(source: Source, trial: Trial, output: Path, trained: tuple[str, ...], held_out: tuple[str, ...]) -> Path:
    if not output.is_dir():
        asked = RecordingExport(
            *(source.recording, trial.layout, output, trained, held_out),  # type: ignore[arg-type]  # a known layout
            frames=tuple(source.numbers),
            downscale=source.downscale,
            points=trial.points,
        )
        try:
            export(asked)
        except D2Error:
            if not (output / EXPORT_FILE).is_file():  # a run beside this one wrote it meanwhile
                raise
    return output.resolve()


def _prior(source: Source, output: Path) -> Path:
    """Built by the command that a user has; a finished one is used again."""
    if (output / "store.json").is_file():
        return output.resolve()
    words = ["priors", str(source.recording), "--train-cameras", ",".join(TRAINED), "--output", str(output)]
    words += ["--frames", f"0:{source.numbers[-1]}:{source.step}", "--downscale", str(source.downscale)]
    done = subprocess.run([str(Path(sys.executable).with_name("d2")), *words], check=False)
    if done.returncode != 0:
        raise D2Error(f"`d2 {' '.join(words)}` ended with code {done.returncode}: its output above says why")
    return output.resolve()

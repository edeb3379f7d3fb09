"""What a camera that is late costs, and what a learnt shift in time wins back: figures of docs/your-recording.md.

    python docs/learnt-clocks.py OUTPUT.md STEPS CAPTURE [CAPTURE ...]

Every second frame of a capture is a recording of half its rate, so that a camera that shows the next frame, or the ones
after, is half a frame late, a whole one, or one and a half. Cameras 00 02 05 07 train, 05 is late, the others are
scored; the backbone alone, pictures made 2 times smaller, seed 0.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from d2_plugin.captures import Capture, Source, open_capture
from d2_plugin.captures.export.folder import save_capture
from d2_plugin.captures.selection import downscale, select_frames
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings

TRAIN, LATE = ("00", "02", "05", "07"), "05"


@dataclass(frozen=True)
class Later:
    """Pictures of another capture: frame f is its frame 2 f, of one camera some frames later."""

    source: Source
    later: int

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        return self.source.image(camera, 2 * frame + (self.later if camera == LATE else 0))

    def depth(self, camera: str, frame: int) -> None:
        """Not scored here."""

    def mono(self, camera: str, frame: int) -> None:
        """Nothing guides these runs."""


def main(output: str, steps: str, *folders: str) -> None:
    """Measure and write the table, row by row."""
    lines = [f"`python docs/learnt-clocks.py OUTPUT {steps} {' '.join(Path(f).name for f in folders)}`", ""]
    lines += ["| recording | 05 late by | learnt | PSNR | where something moves | shift found, frames |"]
    lines += ["|---|---|---|---|---|---|"]
    for folder in folders:
        for row in rows(downscale(open_capture(folder), 2), int(steps)):
            lines.append(row)
            Path(output).write_text("\n".join([*lines, ""]))


def rows(capture: Capture, steps: int) -> Iterator[str]:
    """Each lateness with and without learning."""
    for later in (0, 2, 1, 3):
        for learn in (False, True):
            (psnr, moving), shifts = scored(late(capture, later), steps, learn)
            found = ", ".join(f"{name} {shift:+.2f}" for name, shift in (shifts or {}).items()) or "-"
            about = f"{capture.name} | {later / 2:g} frames | {'yes' if learn else 'no'}"
            yield f"| {about} | {psnr:.2f} dB | {moving:.2f} dB | {found} |"


def late(capture: Capture, later: int) -> Capture:
    """Half the frames, those of one camera taken later; the last two are left out, for which nothing is later."""
    count = (len(capture.frames) - 3) // 2
    plain = replace(capture, source=Later(capture.source, later), fps=capture.fps / 2, mono_kind=None)
    return select_frames(replace(plain, frames=tuple(range(count))), range(count))


def scored(capture: Capture, steps: int, learn: bool) -> tuple[tuple[float, float], dict[str, float] | None]:
    """((PSNR of the held-out cameras, the same where something moves), shifts by camera) of one run."""
    with tempfile.TemporaryDirectory() as folder:
        save_capture(capture, Path(folder) / "capture")
        chosen = {"backbone": {"clocks": {"learn": learn}}}
        settings = RunSettings(
            capture=str(Path(folder) / "capture"), train_cameras=TRAIN, iterations=steps, hooks=(), overrides=chosen
        )
        run = Run(settings, Path(folder) / "run")
        run.train()
        metrics = run.evaluate(pictures=False)
    test = metrics["test"]
    return (float(test["psnr"]), float(test["psnr_moving"])), metrics["clocks"]


if __name__ == "__main__":
    main(*sys.argv[1:])

"""What the angle between two cameras, their exposure, clock and pose cost: the figures of docs/your-recording.md.

    python docs/your-recording.py OUTPUT.md RECORDING [RECORDING ...]

One prior of two cameras at one frame per figure, default settings, nothing drawn at random but the synthetic rig
(seed 0). A recording needs eight cameras 00 to 07 on an arc and monocular maps. The share is that of pixels whose two
depth sources confirm each other; the error is the median of |D - truth| / truth over them where there is a truth.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from d2_plugin.priors.build import build_priors
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings import Recording, Source, open_recording, select_cameras
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.selection import select_frames
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

FRAME, DOWNSCALE = 10, 2
PAIR = ("03", "04")


@dataclass(frozen=True)
class Spoiled(Source):
    """The images of one camera, brighter or of another instant."""

    source: Source
    camera: str
    gain: float = 1.0
    later: int = 0

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        mine = camera == self.camera
        image = self.source.image(camera, frame + (self.later if mine else 0))
        return np.rint(image * self.gain).clip(0, 255).astype(np.uint8) if mine else image

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z or None."""
        return self.source.depth(camera, frame)

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """A monocular map, of the image that is shown."""
        return self.source.mono(camera, frame + (self.later if camera == self.camera else 0))


def main(output: str, *folders: str) -> None:
    """Measure and write one table a question."""
    recordings = {Path(folder).name: open_recording(folder, downscale=DOWNSCALE) for folder in folders}
    about = f"frame {FRAME}, two cameras, images made {DOWNSCALE} times smaller, seed 0"
    lines = [f"`python docs/your-recording.py OUTPUT {' '.join(recordings)}`: {about}.", ""]
    for title, rows in (("degrees apart", angles(recordings)), ("of one camera", spoiled(recordings))):
        lines += [f"| {title} | recording | verified | median error | verified where something moves |"]
        lines += ["|---|---|---|---|---|"]
        for line in rows:
            lines.append(line)
            Path(output).write_text("\n".join([*lines, ""]))
        lines.append("")


def angles(recordings: dict[str, Recording]) -> Iterator[str]:
    """Pairs farther and farther apart."""
    for name, recording in recordings.items():
        for other in ("04", "05", "06", "07"):
            angle = between(recording, "03", other)
            yield row(f"{angle:.0f}", name, measured(recording, ("03", other), lambda recording: recording))
    for angle in (10, 25, 45):
        rig = synthetic_recording(2, 0, FRAME + 1, 160, 90, arc_degrees=float(angle))
        yield row(f"{angle}", "synthetic", measured(rig, tuple(rig.cameras), lambda recording: recording))


def spoiled(recordings: dict[str, Recording]) -> Iterator[str]:
    """One of two neighbours is brighter, late, or not where its calibration says."""
    mistakes: dict[str, Callable[[Recording], Recording]] = {"nothing wrong": lambda recording: recording}
    for gain in (1.15, 1.4):
        mistakes[f"gain {gain:g}"] = lambda c, gain=gain: replace(c, source=Spoiled(c.source, PAIR[1], gain))
    for later in (1, 3):
        mistakes[f"{later} frames late"] = lambda c, later=later: replace(
            c, source=Spoiled(c.source, PAIR[1], 1, later)
        )
    for degrees in (0.1, 0.5, 1.0):
        mistakes[f"turned by {degrees:g} degrees"] = lambda c, degrees=degrees: turned(c, PAIR[1], degrees)
    for what, mistake in mistakes.items():
        for name, recording in recordings.items():
            yield row(what, name, measured(recording, PAIR, mistake))


def turned(recording: Recording, name: str, degrees: float) -> Recording:
    """A camera turned about an axis across its view, half up and half sideways."""
    camera = recording.cameras[name]
    axis = np.deg2rad(degrees) * np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    T = camera.T_camera_world.copy()
    T[:3] = rotation_of_vector(axis) @ T[:3]
    return replace(recording, cameras={**recording.cameras, name: replace(camera, T_camera_world=T)})


def between(recording: Recording, one: str, other: str) -> float:
    """Degrees between two optical axes."""
    a, b = (recording.cameras[name].T_camera_world[2, :3] for name in (one, other))
    return float(np.rad2deg(np.arccos(np.clip(a @ b, -1, 1))))


def measured(
    recording: Recording, names: tuple[str, ...], mistake: Callable[[Recording], Recording]
) -> tuple[float, float, float]:
    """(verified share, median error of it, verified share of what moves) of the first camera, which has no mistake."""
    around = [recording.image(names[0], frame).astype(int) for frame in (FRAME - 2, FRAME)]
    moves = np.abs(around[1] - around[0]).max(-1) > 15
    chosen = mistake(select_frames(select_cameras(recording, names), [FRAME]))
    with tempfile.TemporaryDirectory() as folder:
        build_priors(chosen, names, Path(folder) / "prior", PriorSettings())
        prior = PriorStore.open(Path(folder) / "prior").prior(names[0], FRAME)
        depth, verified = prior.depth.numpy(), prior.labels.numpy() == int(Label.VERIFIED)
    truth = recording.depth(names[0], FRAME)
    known = verified & (truth > 0) if truth is not None else np.zeros_like(verified)
    error = float(np.median(np.abs(depth[known] / truth[known] - 1))) if truth is not None and known.any() else np.nan
    return float(verified.mean()), error, float(verified[moves].mean()) if moves.any() else np.nan


def row(first: str, name: str, figures: tuple[float, float, float]) -> str:
    """A line of a table; what could not be measured is a dash."""
    cells = ["-" if np.isnan(value) else f"{value:.1%}" for value in figures]
    return f"| {first} | {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main(*sys.argv[1:])

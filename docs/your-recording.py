"""What the angle between two cameras, their exposure, clock and pose cost: the figures of docs/your-recording.md.

    python docs/your-recording.py OUTPUT.md CAPTURE [CAPTURE ...]

One prior of two cameras at one frame per figure, default settings, nothing drawn at random but the synthetic rig
(seed 0). A capture needs eight cameras 00 to 07 along an arc and monocular maps. The share is that of pixels whose two
depth sources confirm each other; the error is the median of |D - truth| / truth over them where there is a truth.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from d2_plugin.captures import Capture, Source, open_capture, select_cameras
from d2_plugin.captures.rotations import rotation_of_vector
from d2_plugin.captures.selection import select_frames
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import Label

FRAME, DOWNSCALE = 10, 2
PAIR = ("03", "04")


@dataclass(frozen=True)
class Spoiled:
    """The pictures of one camera, brighter or of another instant."""

    source: Source
    camera: str
    gain: float = 1.0
    later: int = 0

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        mine = camera == self.camera
        picture = self.source.image(camera, frame + (self.later if mine else 0))
        return np.rint(picture * self.gain).clip(0, 255).astype(np.uint8) if mine else picture

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z or None."""
        return self.source.depth(camera, frame)

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """A monocular map, of the picture that is shown."""
        return self.source.mono(camera, frame + (self.later if camera == self.camera else 0))


def main(output: str, *folders: str) -> None:
    """Measure and write one table a question."""
    captures = {Path(folder).name: open_capture(folder, downscale=DOWNSCALE) for folder in folders}
    about = f"frame {FRAME}, two cameras, pictures made {DOWNSCALE} times smaller, seed 0"
    lines = [f"`python docs/your-recording.py OUTPUT {' '.join(captures)}`: {about}.", ""]
    for title, rows in (("degrees apart", angles(captures)), ("of one camera", spoiled(captures))):
        lines += [f"| {title} | recording | verified | median error | verified where something moves |"]
        lines += ["|---|---|---|---|---|"]
        for line in rows:
            lines.append(line)
            Path(output).write_text("\n".join([*lines, ""]))
        lines.append("")


def angles(captures: dict[str, Capture]) -> Iterator[str]:
    """Pairs farther and farther apart."""
    for name, capture in captures.items():
        for other in ("04", "05", "06", "07"):
            angle = between(capture, "03", other)
            yield row(f"{angle:.0f}", name, measured(capture, ("03", other), lambda capture: capture))
    for angle in (10, 25, 45):
        rig = synthetic_capture(2, 0, FRAME + 1, 160, 90, arc_degrees=float(angle))
        yield row(f"{angle}", "synthetic", measured(rig, tuple(rig.cameras), lambda capture: capture))


def spoiled(captures: dict[str, Capture]) -> Iterator[str]:
    """One of two neighbours is brighter, late, or not where its calibration says."""
    mistakes: dict[str, Callable[[Capture], Capture]] = {"nothing wrong": lambda capture: capture}
    for gain in (1.15, 1.4):
        mistakes[f"gain {gain:g}"] = lambda c, gain=gain: replace(c, source=Spoiled(c.source, PAIR[1], gain))
    for later in (1, 3):
        mistakes[f"{later} frames late"] = lambda c, later=later: replace(
            c, source=Spoiled(c.source, PAIR[1], 1, later)
        )
    for degrees in (0.1, 0.5, 1.0):
        mistakes[f"turned by {degrees:g} degrees"] = lambda c, degrees=degrees: turned(c, PAIR[1], degrees)
    for what, mistake in mistakes.items():
        for name, capture in captures.items():
            yield row(what, name, measured(capture, PAIR, mistake))


def turned(capture: Capture, name: str, degrees: float) -> Capture:
    """A camera turned about an axis across its view, half up and half sideways."""
    camera = capture.cameras[name]
    axis = np.deg2rad(degrees) * np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    T = camera.T_camera_world.copy()
    T[:3] = rotation_of_vector(axis) @ T[:3]
    return replace(capture, cameras={**capture.cameras, name: replace(camera, T_camera_world=T)})


def between(capture: Capture, one: str, other: str) -> float:
    """Degrees between two optical axes."""
    a, b = (capture.cameras[name].T_camera_world[2, :3] for name in (one, other))
    return float(np.rad2deg(np.arccos(np.clip(a @ b, -1, 1))))


def measured(
    capture: Capture, names: tuple[str, ...], mistake: Callable[[Capture], Capture]
) -> tuple[float, float, float]:
    """(verified share, median error of it, verified share of what moves) of the first camera, which has no mistake."""
    around = [capture.image(names[0], frame).astype(int) for frame in (FRAME - 2, FRAME)]
    moves = np.abs(around[1] - around[0]).max(-1) > 15
    chosen = mistake(select_frames(select_cameras(capture, names), [FRAME]))
    with tempfile.TemporaryDirectory() as folder:
        build_priors(chosen, names, Path(folder) / "prior", PriorSettings())
        prior = PriorStore.open(Path(folder) / "prior").prior(names[0], FRAME)
        depth, verified = prior.depth.numpy(), prior.labels.numpy() == int(Label.VERIFIED)
    truth = capture.depth(names[0], FRAME)
    known = verified & (truth > 0) if truth is not None else np.zeros_like(verified)
    error = float(np.median(np.abs(depth[known] / truth[known] - 1))) if truth is not None and known.any() else np.nan
    return float(verified.mean()), error, float(verified[moves].mean()) if moves.any() else np.nan


def row(first: str, name: str, figures: tuple[float, float, float]) -> str:
    """A line of a table; what could not be measured is a dash."""
    cells = ["-" if np.isnan(value) else f"{value:.1%}" for value in figures]
    return f"| {first} | {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main(*sys.argv[1:])

"""What a recording has and what it lacks, a line each with what to do: `d2 doctor CAPTURE`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.checks.calibrated import check_capture
from d2_plugin.errors import D2Error

FAR_APART = 35.0
"""Degrees between a camera and its nearest neighbour from which stereo verifies little: see docs/your-recording.md."""

FEW_FRAMES = 2

SHORT_SIDE = 180
"""Pictures with a shorter side have little to match."""

UNEQUAL, UNEQUAL_TIME = 0.02, 0.25
"""Gain off the mean, and lateness in frames, that are worth a word."""


class Finding(NamedTuple):
    """One line."""

    verdict: str
    """`has`, `lacks` or `look`."""
    what: str
    said: str


def lacking_text(capture: Capture) -> str:
    """All findings, aligned."""
    return "\n".join(f"{one.verdict:>6}  {one.what:11} {one.said}" for one in findings(capture))


def findings(capture: Capture) -> list[Finding]:
    """What a recording has and lacks.

    Raises:
        D2Error: a picture that cannot be read, among those looked at.
    """
    rig = list(capture.cameras.values())
    parts = (_cameras(rig), _pictures(capture), _time(capture), _exposure(capture), _maps(capture))
    found = [one for part in parts for one in part]
    notes = [*capture.notes, *check_capture(capture, list(capture.cameras))]
    return [*found, *(Finding("look", "note", note) for note in notes)]


def _cameras(rig: Sequence[Camera]) -> Iterator[Finding]:
    if len(rig) < 2:
        yield Finding("lacks", "cameras", "one camera: without a second one nothing can be triangulated or verified")
        return
    apart = neighbour_angles(rig)
    said = f"{len(rig)}, {min(apart):.0f} to {max(apart):.0f} degrees from the nearest other one"
    yield Finding("has", "cameras", said)
    far = [camera.name for camera, angle in zip(rig, apart) if angle > FAR_APART]
    if far:
        yield Finding(
            "lacks", "overlap", f"{', '.join(far)} more than {FAR_APART:g} degrees from any other: put cameras closer"
        )


def neighbour_angles(rig: Sequence[Camera]) -> list[float]:
    """Degrees from each camera's optical axis to the nearest other camera's."""
    axes = {camera.name: camera.T_camera_world[2, :3] for camera in rig}
    found = {camera.name: 180.0 for camera in rig}
    for one, other in combinations(axes, 2):
        angle = float(np.rad2deg(np.arccos(np.clip(axes[one] @ axes[other], -1, 1))))
        found[one], found[other] = min(found[one], angle), min(found[other], angle)
    return list(found.values())


def _pictures(capture: Capture) -> Iterator[Finding]:
    sizes = sorted({(camera.width, camera.height) for camera in capture.cameras.values()})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes)
    yield Finding("has", "pictures", f"{len(capture.frames)} frames at {capture.fps:g} per second, {shown} pixels")
    if min(min(size) for size in sizes) < SHORT_SIDE:
        yield Finding("lacks", "resolution", f"a side below {SHORT_SIDE} pixels: import with a larger --scale")
    if len(capture.frames) < FEW_FRAMES:
        yield Finding("lacks", "time", "one instant: the scene will not move; import more with --times or --frames")


def _time(capture: Capture) -> Iterator[Finding]:
    late = [abs(seconds) * capture.fps for one in capture.late.values() for seconds in one.values()]
    steps = Path(capture.path, "import", "clocks.json") if capture.path is not None else None
    if late:
        word = "look" if max(late) > UNEQUAL_TIME else "has"
        yield Finding(word, "clock", f"cameras exposed up to {max(late):.2f} frames apart; each keeps its own instants")
    elif steps is None or not steps.is_file():
        yield Finding("look", "clock", "nothing says how the cameras were synchronised: d2 takes equal frame numbers")


def _exposure(capture: Capture) -> Iterator[Finding]:
    known = [name for name in capture.cameras if name in capture.exposures]
    if not known:
        yield Finding("look", "exposure", "not measured: triangulated points will decide whether exposures differ")
        return
    off = {name: float(np.abs(np.log(capture.exposures[name].gain)).max()) for name in known}
    worst = max(off, key=lambda name: off[name])
    word = "look" if off[worst] > UNEQUAL else "has"
    yield Finding(word, "exposure", f"measured; {worst} is off the mean by {off[worst]:.1%} at most")
    unknown = [name for name in capture.cameras if name not in known]
    if unknown:
        yield Finding("lacks", "exposure", f"of {', '.join(unknown)}: too few features shared with the others")


def _maps(capture: Capture) -> Iterator[Finding]:
    camera, frame = next(iter(capture.cameras)), capture.frames[0]
    if capture.mono_kind is None:
        yield Finding("lacks", "mono", "no monocular depth: put maps into mono/, or give --mono-onnx FILE to d2 train")
    else:
        yield Finding("has", "mono", f"{capture.mono_kind} maps{', emulated' if capture.mono_emulated else ''}")
    try:
        truth = capture.depth(camera, frame) is not None
    except D2Error:
        truth = True
    yield Finding("has" if truth else "look", "truth", "true depth" if truth else "no true depth: depth is not scored")
    masked = capture.mask(camera, frame) is not None
    yield Finding("has" if masked else "look", "masks", "of the foreground" if masked else "none: not needed")

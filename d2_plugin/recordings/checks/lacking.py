"""What a recording has and what it lacks, a line each with what to do: `d2 doctor RECORDING`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.check import check_recording
from d2_plugin.recordings.recording import Camera, Recording

FAR_APART = 35.0
"""Degrees between a camera and its nearest neighbour from which stereo verifies little: see docs/your-recording.md."""

SHORT_SIDE = 180  # images with a shorter side have little to match
UNEQUAL, UNEQUAL_TIME = 0.02, 0.25  # gain off the mean, and lateness in frames, that are noted


class Finding(NamedTuple):
    """One line."""

    verdict: str  # `has`, `lacks` or `check`
    what: str
    text: str


def lacking_text(recording: Recording) -> str:
    """All findings, aligned."""
    return "\n".join(f"{one.verdict:>6}  {one.what:11} {one.text}" for one in findings(recording))


def findings(recording: Recording) -> list[Finding]:
    """What a recording has and lacks.

    Raises:
        D2Error: an image that cannot be read, among those read.
    """
    rig = list(recording.cameras.values())
    parts = (_cameras(rig), _images(recording), _time(recording), _exposure(recording), _maps(recording))
    all_parts = [one for part in parts for one in part]
    notes = [*recording.notes, *check_recording(recording, list(recording.cameras))]
    return [*all_parts, *(Finding("check", "note", note) for note in notes)]


def _cameras(rig: Sequence[Camera]) -> Iterator[Finding]:
    if len(rig) < 2:
        yield Finding("lacks", "cameras", "one camera: without a second one nothing can be triangulated or verified")
        return
    axes = np.stack([camera.T_camera_world[2, :3] for camera in rig])
    angles = np.rad2deg(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    np.fill_diagonal(angles, 180.0)
    apart = angles.min(axis=1)  # degrees from each camera's optical axis to the nearest other camera's
    yield Finding(
        "has", "cameras", f"{len(rig)}, {min(apart):.0f} to {max(apart):.0f} degrees from the nearest other one"
    )
    far = [camera.name for camera, angle in zip(rig, apart) if angle > FAR_APART]
    if far:
        yield Finding(
            "lacks", "overlap", f"{', '.join(far)} more than {FAR_APART:g} degrees from any other: put cameras closer"
        )


def _images(recording: Recording) -> Iterator[Finding]:
    sizes = sorted({(camera.width, camera.height) for camera in recording.cameras.values()})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes)
    yield Finding("has", "images", f"{len(recording.frames)} frames at {recording.rate:g} per second, {shown} pixels")
    if min(min(size) for size in sizes) < SHORT_SIDE:
        yield Finding("lacks", "resolution", f"a side below {SHORT_SIDE} pixels: import with a larger --scale")
    if len(recording.frames) < 2:
        yield Finding("lacks", "time", "one instant: the scene will not move; import more with --times or --frames")


def _time(recording: Recording) -> Iterator[Finding]:
    late = [abs(seconds) * recording.fps for one in recording.late.values() for seconds in one.values()]
    steps = Path(recording.path, "import", "clocks.json") if recording.path is not None else None
    if late:
        word = "check" if max(late) > UNEQUAL_TIME else "has"
        yield Finding(word, "clock", f"cameras exposed up to {max(late):.2f} frames apart; each keeps its own instants")
    elif steps is None or not steps.is_file():
        yield Finding("check", "clock", "nothing says how the cameras were synchronised: d2 takes equal frame numbers")


def _exposure(recording: Recording) -> Iterator[Finding]:
    known = [name for name in recording.cameras if name in recording.exposures]
    if not known:
        yield Finding("check", "exposure", "not measured: triangulated points will decide whether exposures differ")
        return
    off = {name: float(np.abs(np.log(recording.exposures[name].gain)).max()) for name in known}
    worst = max(off, key=lambda name: off[name])
    word = "check" if off[worst] > UNEQUAL else "has"
    yield Finding(word, "exposure", f"measured; {worst} is off the mean by {off[worst]:.1%} at most")
    unknown = [name for name in recording.cameras if name not in known]
    if unknown:
        yield Finding("lacks", "exposure", f"of {', '.join(unknown)}: too few features shared with the others")


def _maps(recording: Recording) -> Iterator[Finding]:
    camera, frame = next(iter(recording.cameras)), recording.frames[0]
    if recording.mono_kind is None:
        yield Finding("lacks", "mono", "no monocular depth: put maps into mono/, or give --mono-onnx FILE to d2 train")
    else:
        yield Finding("has", "mono", f"{recording.mono_kind} maps{', emulated' if recording.mono_emulated else ''}")
    try:
        truth = recording.depth(camera, frame) is not None
    except D2Error:
        truth = True
    yield Finding("has" if truth else "check", "truth", "true depth" if truth else "no true depth: depth is not scored")
    masked = recording.mask(camera, frame) is not None
    yield Finding("has" if masked else "check", "masks", "of the foreground" if masked else "none: not needed")

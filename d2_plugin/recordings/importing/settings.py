"""What `d2 import` takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from d2_plugin.errors import D2Error
from d2_plugin.settings import Count, Positional, Range, Settings

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # Metres in the units of calibration files


@dataclass(frozen=True)
class ImportChoices(Settings):
    """How videos become a recording on one clock."""

    offsets: tuple[str, ...] = ("auto",)
    """How the cameras' start is found: auto (timecode, then sound, then motion), timecode, sound, motion, none (they
    start together), or given as NAME=FRAMES,...: how many of its frames after the first camera each one started."""
    times: tuple[Annotated[float, Range(0, 1e6, unit="seconds")], ...] | None = None
    """First and last second to take, joined by a comma, of the time that all cameras recorded."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames to take, written first:last or first:last:step, the last one included."""
    rate: Annotated[float, Range(1e-3, 1000, unit="frames per second")] | None = None
    """Frames to take per second; those of the slowest camera if not given."""
    scale: Annotated[float, Range(1e-4, 1)] = 1.0
    """Make images smaller by this factor."""
    crop: tuple[str, ...] = ()
    """Part to keep, WIDTHxHEIGHT+LEFT+TOP in pixels of the upright video; NAME=... for one camera, joined by commas."""
    images: Literal["png", "jpg", "videos"] = "png"
    """Write images as png (lossless) or jpg, or leave them in the videos, which are decoded when they are needed."""
    unit: Literal["m", "cm", "mm"] | None = None
    """Unit of the calibration's positions; the recording is in metres then."""
    exposure: bool = True
    """Measure how much brighter one camera sees the same surfaces than the others."""
    refine_poses: bool = False
    """Correct the poses of the calibration by features of all cameras; kept as they are where that mends nothing."""
    accept_calibration: bool = False
    """Import though features contradict the calibration, or a camera seems to have been moved; a note says so."""

    intrinsics: Path | None = None
    """Without a calibration: a file with the lenses alone, in any of its formats; its poses are not used."""
    focal: tuple[str, ...] = ("shared",)
    """Without a calibration and intrinsics: focal lengths in pixels of the upright video, one number or NAME=PIXELS,
    joined by commas; or how they are found: shared (one for all cameras, as of phones of one model) or each."""
    stills: Path | None = None
    """Without a calibration: a folder of images of the same scene from places between the cameras, which connect
    cameras that see too little in common. Called CAMERA_NUMBER where the cameras' lenses differ."""
    board: str | None = None
    """Without a calibration: a board that was filmed, charuco:COLUMNSxROWS:SQUARE:MARKER or
    checkerboard:COLUMNSxROWS:SQUARE, in squares and metres. It says how large the world is."""
    distance: tuple[str, ...] | None = None
    """Without a calibration: how far two cameras stand apart, CAMERA,CAMERA,METRES."""


OF_A_SOLVED_RIG = {"intrinsics": None, "focal": ("shared",), "stills": None, "board": None, "distance": None}
"""What only an import without a calibration takes, and what says nothing."""


@dataclass(frozen=True, kw_only=True)
class ImportSettings(ImportChoices):
    """Which videos become which recording."""

    videos: Annotated[tuple[Path, ...], Positional()]
    """Videos, one per camera and called like it; or the folder that holds them."""
    calibration: Path | None = None
    """Calibration of the cameras, in any format of docs/calibration.md; without one it is found from the videos."""
    output: Path
    """Folder of the recording; an import in it that was stopped is continued."""


def check_calibration(settings: ImportSettings) -> None:
    """Refuse a calibration together with what would find one."""
    given = [name for name, nothing in OF_A_SOLVED_RIG.items() if getattr(settings, name) != nothing]
    if settings.calibration is not None and given:
        raise D2Error(
            f"--calibration and --{given[0]} are both given, and a rig is either known or found from the videos: leave "
            "one out"
        )
    if settings.calibration is None and settings.unit is not None:
        raise D2Error("--unit says what a calibration is in, and none is given: give --distance or --board for a scale")


def by_camera(
    option: str, texts: Sequence[str], names: Iterable[str], value: Callable[[str], Any], expected: str
) -> dict:
    """The value of each camera out of VALUE (for all) and NAME=VALUE; `value` gives None for what is none.

    Raises:
        D2Error: a camera that is not among `names`, or what is no value.
    """
    values: dict[str, Any] = {}
    seen: list[str] = []
    for text in texts:
        name, named, written = text.rpartition("=")
        if named and name in seen:
            raise D2Error(f"{option} names camera '{name}' twice: leave one of them out")
        seen += [name] if named else []
        if named and name not in names:
            raise D2Error(f"{option} names camera '{name}', have {', '.join(names)}: correct the name")
        given = value(written.strip())
        if given is None:
            raise D2Error(f"{option} says '{text}', expected {expected}: correct it")
        values |= dict.fromkeys([name] if named else names, given)
    return values


def finite(text: str) -> float | None:
    """A number, None for what is none."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None

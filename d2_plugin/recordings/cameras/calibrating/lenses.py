"""The lenses of cameras whose poses are looked for: from a calibration, from a number, or to be found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibration import pinhole
from d2_plugin.recordings.cameras.formats import CalibratedCamera, open_calibration

SHARED, EACH = "shared", "each"
"""Focal lengths that are found: one for all cameras, or one for each of them."""


@dataclass(frozen=True)
class Lenses:
    """Cameras without poses, and whether their focal lengths are known, `SHARED` or `EACH` of its own."""

    cameras: dict[str, CalibratedCamera]
    focal: str | None
    """None where it is known."""


def lenses_of(intrinsics: Path | None, focal: Sequence[str], sizes: Mapping[str, tuple[int, int]]) -> Lenses:
    """The lenses of cameras whose upright images have `sizes` (width, height).

    Args:
        intrinsics: a calibration whose poses are not looked at; None where there is none.
        focal: `SHARED`, `EACH`, or pixels: one number, or one NAME=PIXELS per camera.

    Raises:
        D2Error: two sources, a number that no lens has, cameras that are not there or of two shapes that share one.
    """
    if intrinsics is not None:
        if tuple(focal) != (SHARED,):
            raise D2Error("--intrinsics and --focal both say how the lenses are: give one of them")
        read = open_calibration(intrinsics, sizes)
        return Lenses({camera.name: _at_the_origin(camera) for camera in read.cameras}, None)
    if tuple(focal) in ((SHARED,), (EACH,)):
        if focal[0] == SHARED and len(set(sizes.values())) > 1:
            raise D2Error(
                "the videos have different sizes, so their cameras share no focal length: give --focal each, pixels "
                "as --focal NAME=PIXELS,..., or --intrinsics FILE"
            )
        return Lenses({name: _plain(name, size, float(max(size))) for name, size in sizes.items()}, focal[0])
    lengths = _lengths(focal, list(sizes))
    return Lenses({name: _plain(name, size, lengths[name]) for name, size in sizes.items()}, None)


def _lengths(focal: Sequence[str], names: Sequence[str]) -> dict[str, float]:
    """Pixels by camera."""
    found: dict[str, float] = {}
    for text in focal:
        name, named, number = text.rpartition("=")
        if named and name not in names:
            raise D2Error(f"--focal names camera '{name}', have {', '.join(names)}: correct the name")
        try:
            length = float(number)
        except ValueError:
            length = 0.0
        if not (np.isfinite(length) and length > 0):
            raise D2Error(
                f"--focal says '{text}', expected shared, each, a number of pixels above 0, or NAME=PIXELS: correct it"
            )
        found |= {name: length} if named else dict.fromkeys(names, length)
    lost = [name for name in names if name not in found]
    if lost:
        raise D2Error(f"--focal says nothing of camera {', '.join(lost)}: add NAME=PIXELS, or give one number for all")
    return found


def _plain(name: str, size: tuple[int, int], length: float) -> CalibratedCamera:
    """A camera without distortion whose principal point is the middle of the image."""
    K = pinhole(length, length, size[0] / 2, size[1] / 2)
    return CalibratedCamera(name, *size, K, "pinhole", (), np.eye(3), np.zeros(3))


def _at_the_origin(camera: CalibratedCamera) -> CalibratedCamera:
    about = (camera.name, camera.width, camera.height, camera.matrix, camera.model, camera.distortion)
    return CalibratedCamera(*about, np.eye(3), np.zeros(3))

"""The calibration formats that can be read, in one table, and `read_calibration`, which finds the right one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import reaching
from d2_plugin.recordings.cameras.formats import (
    cameras_json,
    colmap,
    easymocap,
    kalibr,
    multical,
    panoptic,
    toml_tables,
    transforms,
)
from d2_plugin.recordings.cameras.formats.camera import CalibratedCamera, Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document
from d2_plugin.recordings.cameras.formats.names import matched
from d2_plugin.values import checked_arguments

log = logging.getLogger(__name__)

LARGE_RIG = 100.0
"""Rigs wider than this are noted: nobody videos with two to ten cameras a hundred metres apart, while a room in
millimetres or centimetres comes out this wide."""


class Format(NamedTuple):
    """One format of calibration files."""

    recognised: Callable[[Document], bool]
    """Whether a file or folder is of this format, from its content."""
    read: Callable[[Document], Sequence[Entry]]


FORMATS: dict[str, Format] = {
    "folder": Format(cameras_json.recognised, cameras_json.read),
    "caliscope": Format(toml_tables.is_caliscope, toml_tables.read_caliscope),
    "pose2sim": Format(toml_tables.is_pose2sim, toml_tables.read_tables),
    "anipose": Format(toml_tables.is_anipose, toml_tables.read_tables),
    "easymocap": Format(easymocap.recognised, easymocap.read),
    "kalibr": Format(kalibr.recognised, kalibr.read),
    "multical": Format(multical.recognised, multical.read),
    "panoptic": Format(panoptic.recognised, panoptic.read),
    "transforms": Format(transforms.recognised, transforms.read),
    "colmap": Format(colmap.is_model, colmap.read_model_folder),
    "colmap_rig": Format(colmap.is_rig, colmap.read_rig),
}
"""By name, in the order in which a file is tried. A new format is one module here and one row."""


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says: its cameras, the name of its format, and what a person should know about it."""

    cameras: tuple[CalibratedCamera, ...]
    format: str
    notes: tuple[str, ...]


@checked_arguments
def read_calibration(
    path: Path | str, sizes: Mapping[str, tuple[int, int]] | None = None
) -> tuple[CalibratedCamera, ...]:
    """The cameras of a calibration file or folder in one of `FORMATS`; what is odd about it is logged.

    Args:
        path: a file; or a folder that is a COLMAP model, holds intri.yml and extri.yml, or one calibration file.
        sizes: (width, height) in pixels of the recordings by name. The cameras come back under these names and in this
            order, scaled to these sizes; cameras of the file without a recording are left out. How names are matched
            is in `d2_plugin.recordings.cameras.formats.names`.

    Raises:
        D2Error: one sentence for an unknown format, a recording that the file does not describe, and numbers that no
            camera has: among others rotations that are mirrored (left-handed) or not orthonormal.
    """
    calibration = open_calibration(path, sizes)
    for note in calibration.notes:
        log.warning("%s: %s", Path(path).name, note)
    return calibration.cameras


@checked_arguments
def open_calibration(path: Path | str, sizes: Mapping[str, tuple[int, int]] | None = None) -> Calibration:
    """`read_calibration` with the name of the format and the notes, which it does not log."""
    if sizes is not None and not sizes:
        raise D2Error(f"{path} is read for no recording: name at least one with its size, or leave the sizes out")
    with reaching(path, CORRECT):
        document = _document(Path(path))
        name = _recognised(document)
        entries = list(FORMATS[name].read(document))
    if not entries:
        raise D2Error(f"{path} ({name}) describes no camera: give a finished calibration")
    _refuse_twice(entries, document.place)
    named, notes = matched(entries, list(sizes), document.place) if sizes is not None else (entries, ())
    cameras = tuple(_camera(entry, None if sizes is None else sizes[entry.name], document.place) for entry in named)
    return Calibration(cameras, name, (*notes, *_scale_notes(cameras)))


def _document(path: Path) -> Document:
    """The file, or the one calibration in a folder that is none itself."""
    if not path.exists():
        raise D2Error(f"no such calibration: {path} is not there; give a calibration file or folder")
    if path.stem in ("cameras", "images", "points3D") and path.suffix in (".bin", ".txt"):
        path = path.parent  # a part of a COLMAP model
    whole = Document(path)
    if not path.is_dir() or any(form.recognised(whole) for form in FORMATS.values()):
        return whole
    files = [file for file in sorted(path.iterdir()) if file.suffix in (".toml", ".json", ".yaml", ".yml")]
    found = [document for document in map(Document, files) if _formats(document)]
    if len(found) != 1:
        listed = ", ".join(document.path.name for document in found) or "none"
        raise D2Error(f"{path} holds {len(found)} calibrations ({listed}), expected one: give the file")
    return found[0]


def _formats(document: Document) -> list[str]:
    return [name for name, form in FORMATS.items() if form.recognised(document)]


def _recognised(document: Document) -> str:
    names = _formats(document)
    if not names:
        raise D2Error(
            f"{document.place} is no calibration that can be read: expected one of {', '.join(FORMATS)}, see "
            "docs/calibration.md"
        )
    return names[0]


def _camera(entry: Entry, size: tuple[int, int] | None, place: str) -> CalibratedCamera:
    camera = entry.recorded(size, place)
    _refuse_mirrored(camera, place)
    camera.pinhole(place)
    return replace(camera, rotation=_nearest_rotation(camera.rotation))


def _refuse_mirrored(camera: CalibratedCamera, place: str) -> None:
    if np.linalg.det(camera.rotation) < 0:
        raise D2Error(
            f"camera {camera.name} in {place} has a mirrored pose (its R has determinant -1): the file was written "
            "with left-handed axes; export it with right-handed ones"
        )


def _nearest_rotation(rotation: np.ndarray) -> np.ndarray:
    """Rounding in text files removed: six decimals leave R R^T off by 1e-6."""
    left, _, right = np.linalg.svd(rotation)
    return left @ right


def _refuse_twice(entries: Sequence[Entry], place: str) -> None:
    names = [entry.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise D2Error(f"{place} describes camera {twice} twice: remove one")


def _scale_notes(cameras: Sequence[CalibratedCamera]) -> tuple[str, ...]:
    """A rig that is too wide for metres, with the scale that would mend it."""
    centres = np.stack([camera.centre for camera in cameras])
    width = float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())
    if width <= LARGE_RIG:
        return ()
    millimetres = "millimetres (scale .001)"
    unit = millimetres if width > 10 * LARGE_RIG else f"centimetres (scale .01) or, of a small rig, {millimetres}"
    return (f"the cameras stand up to {width:.3g} apart, which looks like {unit} instead of metres: give that scale",)

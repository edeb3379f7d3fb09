"""Calibration files of other tools: the formats in one table, and `open_calibration`, which finds the right one.

Which camera of a file belongs to which recording, in this order: equal names; one name that holds the other (hd_00_05
and 00_05); equal last numbers (int_cam1_img and cam01); and, with a note, the order of names where there are as many
recordings as cameras. A way counts where it gives every recording one camera, and no camera twice.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import eq
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import reaching
from d2_plugin.recordings.cameras.camera import CalibratedCamera, rig_width, rigid
from d2_plugin.recordings.cameras.formats import tools
from d2_plugin.recordings.cameras.formats.cameras_json import read_cameras_json
from d2_plugin.recordings.cameras.formats.colmap import read_colmap, read_rig_config
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document
from d2_plugin.recordings.cameras.formats.easymocap import read_easymocap
from d2_plugin.recordings.cameras.formats.transforms import read_transforms
from d2_plugin.values import checked_arguments

LARGE_RIG = 100.0
"""Rigs wider than this are noted: nobody films with two to ten cameras a hundred metres apart, while a room in
millimetres or centimetres comes out this wide."""

SUFFIXES = (".toml", ".json", ".yaml", ".yml", ".xml")
"""Of the files in a folder that may be its calibration, beside .qca.txt."""

FORMATS: dict[str, Callable[[Document], list[CalibratedCamera] | None]] = {
    "folder": read_cameras_json,
    "caliscope": tools.read_caliscope,
    "pose2sim": tools.read_pose2sim,
    "anipose": tools.read_anipose,
    "easymocap": read_easymocap,
    "kalibr": tools.read_kalibr,
    "multical": tools.read_multical,
    "panoptic": tools.read_panoptic,
    "qualisys": tools.read_qualisys,
    "opencv": tools.read_opencv,
    "transforms": read_transforms,
    "colmap": read_colmap,
    "colmap_rig": read_rig_config,
}
"""By name, in the order in which a file is tried. A new format is one function in formats/ and one row."""


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says: its cameras, the name of its format, and what a person should know about it."""

    cameras: tuple[CalibratedCamera, ...]
    format: str
    notes: tuple[str, ...]


@checked_arguments
def open_calibration(path: Path | str, sizes: Mapping[str, tuple[int, int]] | None = None) -> Calibration:
    """What a calibration file or folder in one of `FORMATS` says.

    Args:
        path: a file; or a folder that is a COLMAP model, holds intri.yml and extri.yml, or one calibration file.
        sizes: (width, height) in pixels of the recordings by name. The cameras come back under these names and in this
            order, scaled to these sizes; cameras of the file without a recording are left out.

    Raises:
        D2Error: one sentence for an unknown format, a recording that the file does not describe, and numbers that no
            camera has: among others rotations that are mirrored (left-handed) or not orthonormal.
    """
    if sizes is not None and not sizes:
        raise D2Error(f"{path} is read for no recording: name at least one with its size, or leave the sizes out")
    with reaching(path, CORRECT):
        form, cameras = _recognised(Path(path))
    names = [camera.name for camera in cameras]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise D2Error(f"{path} describes camera {twice} twice: remove one")
    notes: tuple[str, ...] = ()
    if sizes is not None:
        cameras, notes = _matched(cameras, list(sizes), str(path))
        cameras = [camera.of_size(sizes[camera.name], str(path)) for camera in cameras]
    checked = tuple(_checked(camera, str(path)) for camera in cameras)
    return Calibration(checked, form, (*notes, *_scale_notes(checked)))


def _recognised(path: Path) -> tuple[str, list[CalibratedCamera]]:
    """(format, cameras) of a file or folder, or of the one calibration in a folder that is none itself."""
    if not path.exists():
        raise D2Error(f"no such calibration: {path} is not there; give a calibration file or folder")
    if path.stem in ("cameras", "images", "points3D") and path.suffix in (".bin", ".txt"):
        path = path.parent  # a part of a COLMAP model
    read = _read(path)
    if read is None and path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix in SUFFIXES or file.name.endswith(".qca.txt")]
        several = {file.name: read for file in files if (read := _read(file)) is not None}
        if len(several) != 1:
            listed = ", ".join(several) or "none"
            raise D2Error(f"{path} holds {len(several)} calibrations ({listed}), expected one: give the file")
        (read,) = several.values()
    if read is None:
        raise D2Error(
            f"{path} is no calibration that can be read: expected one of {', '.join(FORMATS)}, see docs/calibration.md"
        )
    if not read[1]:
        raise D2Error(f"{path} ({read[0]}) describes no camera: give a finished calibration")
    return read


def _read(path: Path) -> tuple[str, list[CalibratedCamera]] | None:
    document = Document(path)
    for name, read in FORMATS.items():
        cameras = read(document)
        if cameras is not None:
            return name, cameras
    return None


def _checked(camera: CalibratedCamera, place: str) -> CalibratedCamera:
    """The camera with the rotation nearest to the file's: six decimals leave R R^T off by 1e-6."""
    if not camera.width:
        raise D2Error(f"{place} names no size of the images of camera {camera.name}: give the recordings with it")
    T = camera.T_camera_world
    if np.isfinite(T).all() and np.linalg.det(T[:3, :3]) < 0:
        raise D2Error(
            f"camera {camera.name} in {place} has a mirrored pose (its R has determinant -1): the file was written "
            "with left-handed axes; export it with right-handed ones"
        )
    camera.pinhole(place)
    left, _, right = np.linalg.svd(T[:3, :3])
    return replace(camera, T_camera_world=rigid(left @ right, T[:3, 3]))


def _scale_notes(cameras: Sequence[CalibratedCamera]) -> tuple[str, ...]:
    """A rig that is too wide for metres, with the scale that would mend it."""
    width = rig_width(cameras)
    if width <= LARGE_RIG:
        return ()
    millimetres = "millimetres (scale .001)"
    unit = millimetres if width > 10 * LARGE_RIG else f"centimetres (scale .01) or, of a small rig, {millimetres}"
    return (f"the cameras stand up to {width:.3g} apart, which looks like {unit} instead of metres: give that scale",)


def _matched(
    cameras: Sequence[CalibratedCamera], recordings: Sequence[str], place: str
) -> tuple[list[CalibratedCamera], tuple[str, ...]]:
    """(the cameras under the names of the recordings and in their order, notes)."""
    by_name = {camera.name: camera for camera in cameras}
    pairs = next((pairs for same in (eq, _holds, _same_number) if (pairs := _pairs(by_name, recordings, same))), None)
    if pairs is not None:
        return [replace(by_name[pairs[name]], name=name) for name in recordings], ()
    if len(cameras) != len(recordings):
        absent = [name for name in recordings if name not in by_name] or recordings
        some = ", ".join(list(by_name)[:8]) + (f" and {len(by_name) - 8} more" if len(by_name) > 8 else "")
        raise D2Error(
            f"{place} has no camera for {', '.join(absent)}, only {some}: name the recordings as the calibration does"
        )
    by_order = dict(zip(sorted(recordings, key=_natural), sorted(by_name, key=_natural)))
    listed = ", ".join(f"{name} is {camera}" for name, camera in by_order.items())
    note = f"names differ, so cameras were matched in the order of names ({listed}): rename them if that is wrong"
    return [replace(by_name[by_order[name]], name=name) for name in recordings], (note,)


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts cam2 before cam10."""
    return [(int(part), "") if part.isdecimal() else (0, part.lower()) for part in re.split(r"(\d{1,18})", name)]


def _pairs(
    cameras: Mapping[str, CalibratedCamera], recordings: Sequence[str], same: Callable[[str, str], bool]
) -> dict[str, str] | None:
    """Recording -> camera where every recording has exactly one and no two share it, else None."""
    candidates = {name: [camera for camera in cameras if same(camera, name)] for name in recordings}
    pairs = {name: ones[0] for name, ones in candidates.items() if len(ones) == 1}
    return pairs if len(set(pairs.values())) == len(recordings) else None


def _holds(camera: str, recording: str) -> bool:
    """Whether one name stands in the other and does not cut a number or a word."""
    edge, names = r"[^\W_]", (camera.lower(), recording.lower())
    return any(re.search(rf"(?<!{edge}){re.escape(part)}(?!{edge})", whole) for part, whole in (names, reversed(names)))


def _same_number(camera: str, recording: str) -> bool:
    one, other = (re.findall(r"\d{1,18}", name) for name in (camera, recording))
    return bool(one) and bool(other) and int(one[-1]) == int(other[-1])

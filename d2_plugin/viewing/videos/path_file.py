"""nerfstudio's camera_path.json, as its viewer and others write it.

Poses are camera-to-world in OpenGL axes (x right, y up, z back), the field of view is vertical and in degrees. The path
must be in the world of the recording: a `dataparser_transforms.json` beside it, with which nerfstudio turned and
scaled that world, is undone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Optional

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import NoSuchFile, field, read_json
from d2_plugin.recordings.cameras.camera import LARGEST_NUMBER, LARGEST_SIDE, ROTATION_TOLERANCE
from d2_plugin.values import Range
from d2_plugin.viewing.paths import Lens, Pose

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's camera axes to OpenGL's and back."""

EXPORT = "export the camera path again"

Side = Annotated[int, Range(1, LARGEST_SIDE, unit="pixels")]
Vertical = Annotated[float, Range(0, 180, unit="degrees", open_low=True, open_high=True)]
Above0 = Annotated[float, Range(0, LARGEST_NUMBER, open_low=True)]


class CameraPath(NamedTuple):
    """What a file says."""

    poses: list[Pose]
    shares: list[float] | None
    """The instant of each pose, 0 first and 1 last of the recording; None where the file leaves time to run."""
    fps: float


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera_path.json.

    Raises:
        D2Error: not such a file, an empty path, or a camera that is not a perspective one.
    """
    try:
        table = read_json(path, EXPORT)
    except NoSuchFile:
        raise D2Error(f"no camera path at {path}: give orbit, spiral, through, held-out, training or a file") from None
    kind = table.get("camera_type", "perspective")
    if kind != "perspective":
        raise D2Error(f"{path} is for a camera of type {str(kind)[:40]!r}, expected perspective: export it as that")
    width, height = (field(table, name, Side, str(path), EXPORT) for name in ("render_width", "render_height"))
    entries = field(table, "camera_path", list, str(path), EXPORT)
    if not entries:
        raise D2Error(f"the camera path {path} has no camera: add keyframes and {EXPORT}")
    undone = _undone(path.parent / "dataparser_transforms.json")
    places = [f"camera {number} of {path}" for number in range(len(entries))]
    poses = [_pose(entry, (width, height), undone, place) for entry, place in zip(entries, places, strict=True)]
    return CameraPath(poses, _shares(entries, places), _rate(table, len(poses), str(path)))


def _pose(entry: Any, size: tuple[int, int], undone: tuple[np.ndarray, float], place: str) -> Pose:
    if not isinstance(entry, Mapping):
        raise D2Error(f"{place} is no object: {EXPORT}")
    to_recording, scale = undone
    T_world_camera = _matrix(entry, "camera_to_world", 4, place)
    T_world_camera[:3, 3] /= scale
    angle = field(entry, "fov", Vertical, place, EXPORT)
    focal = size[1] / 2 / np.tan(np.radians(angle) / 2)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return Pose(_inverse(to_recording @ T_world_camera @ OPENGL, place), Lens(K, *size))


def _shares(entries: list[Any], places: list[str]) -> list[float] | None:
    kind = Optional[Annotated[float, Range()]]  # noqa: UP045  at run time, on Python 3.9 too
    times = [
        field(entry, "render_time", kind, place, EXPORT, default=None)
        for entry, place in zip(entries, places, strict=True)
    ]
    known = [float(np.clip(time, 0, 1)) for time in times if time is not None]
    return known if len(known) == len(times) else None


def _rate(table: Mapping[str, Any], count: int, place: str) -> float:
    """Images per second: as the file says, or from its length, which is a second where nothing is said."""
    if table.get("fps"):
        return field(table, "fps", Above0, place, EXPORT)
    return count / (field(table, "seconds", Above0, place, EXPORT) if table.get("seconds") else 1.0)


def _undone(path: Path) -> tuple[np.ndarray, float]:
    """From nerfstudio's world, once divided by the scale, back to the recording's."""
    if not path.is_file():
        return np.eye(4), 1.0
    table = read_json(path, EXPORT)
    scale = field(table, "scale", Above0, str(path), EXPORT)
    return _inverse(_matrix(table, "transform", 3, str(path)), str(path)), scale


def _matrix(table: Mapping[str, Any], name: str, rows: int, place: str) -> np.ndarray:
    """The pose under `name`, [4, 4]: nested or not, its first three rows at least."""
    try:
        values = np.array(field(table, name, list, place, EXPORT), np.float64)
        found = np.eye(4)
        found[:rows] = values.reshape(rows, 4)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, D2Error):
            raise
        raise D2Error(f"{name} of {place} is no matrix of {rows} x 4 numbers: {EXPORT}") from None
    if not (np.abs(found) <= LARGEST_NUMBER).all():
        raise D2Error(f"{name} of {place} has a number that is not finite or too large: {EXPORT}")
    return found


def _inverse(T: np.ndarray, place: str) -> np.ndarray:
    """The inverse of a pose, which must be rigid."""
    rotation = T[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise D2Error(f"the pose of {place} turns by no rotation (orthonormal rows, determinant +1): {EXPORT}")
    return np.linalg.inv(T)

"""nerfstudio's camera_path.json, as its viewer and others write it.

Poses are camera-to-world in OpenGL axes (x right, y up, z back), the field of view is vertical and in degrees. The path
must be in the world of the recording: a `dataparser_transforms.json` beside it, with which nerfstudio turned and
scaled that world, is undone.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.viewing.paths import Lens, Pose

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's camera axes to OpenGL's and back."""


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
        table = json.loads(path.read_text())
    except FileNotFoundError:
        raise D2Error(f"no camera path at {path}: give orbit, spiral, through, held-out, training or a file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise D2Error(f"{path} is no JSON ({error}): export the camera path again") from None
    try:
        return _read(table, _undone(path.parent))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        if isinstance(error, D2Error):
            raise
        raise D2Error(f"{path} is no camera_path.json of nerfstudio ({error!r}): export it again") from None


def _read(table: dict[str, Any], undone: tuple[np.ndarray, float]) -> CameraPath:
    kind = table.get("camera_type", "perspective")
    if kind != "perspective":
        raise D2Error(f"the camera path is for a camera of type '{kind}', expected perspective: export it as that")
    size = int(table["render_width"]), int(table["render_height"])
    entries = table["camera_path"]
    if not entries:
        raise D2Error("the camera path has no camera: add keyframes and export it again")
    poses = [_pose(entry, size, undone) for entry in entries]
    times = [entry.get("render_time") for entry in entries]
    shares = None if any(time is None for time in times) else [float(np.clip(time, 0, 1)) for time in times]
    return CameraPath(poses, shares, float(table.get("fps") or len(poses) / (table.get("seconds") or 1)))


def _pose(entry: dict[str, Any], size: tuple[int, int], undone: tuple[np.ndarray, float]) -> Pose:
    to_recording, scale = undone
    T_world_camera = np.array(entry["camera_to_world"], np.float64).reshape(4, 4)
    T_world_camera[:3, 3] /= scale
    T = np.linalg.inv(to_recording @ T_world_camera @ OPENGL)
    angle = float(entry["fov"])
    if not 0 < angle < 180:
        raise ValueError(f"a field of view of {angle:g} degrees")
    focal = size[1] / 2 / np.tan(np.radians(angle) / 2)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    if not np.isfinite(T).all():
        raise ValueError("a pose that is not finite")
    return Pose(T, Lens(K, *size))


def _undone(folder: Path) -> tuple[np.ndarray, float]:
    """From nerfstudio's world, once divided by the scale, back to the recording's."""
    path = folder / "dataparser_transforms.json"
    if not path.is_file():
        return np.eye(4), 1.0
    table = json.loads(path.read_text())
    T = np.eye(4)
    T[:3] = np.array(table["transform"], np.float64)[:3]
    return np.linalg.inv(T), float(table["scale"])

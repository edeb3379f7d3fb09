"""Camera paths: a camera for each image of a video, made from the cameras of a recording or read.

All poses are `T_camera_world` [4, 4] float64 in OpenCV axes. What few cameras did not see cannot be shown: an orbit
stays inside the angle that they span.

nerfstudio's camera_path.json has poses camera-to-world in OpenGL axes (x right, y up, z back), and vertical fields of
view in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple, Optional

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import NoSuchFile, field, json_text, read_json
from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.camera import (
    LARGEST_NUMBER,
    LARGEST_SIDE,
    OPENGL_TO_OPENCV,
    checked_camera,
    focus_of,
    look_at,
    pinhole,
    rigid,
    unit,
)
from d2_plugin.recordings.cameras.formats.document import numbers
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation, rotation_of_quaternion, rotation_of_vector
from d2_plugin.values import Range

ALL_AROUND = 270.0
"""Cameras that span more than this many degrees stand all around: an orbit is then a whole turn."""
LEAST_SWING = 12.0
"""Degrees that an orbit swings at least, where cameras stand close together."""
MARGIN = 10.0
"""Degrees that a free camera may go beyond where cameras stood."""
NEAREST, FARTHEST = 0.35, 1.25
"""How near and how far it may go, relative to the nearest and the farthest camera."""

EXPORT = "export the camera path again"

Side = Annotated[int, Range(1, LARGEST_SIDE, unit="pixels")]
Vertical = Annotated[float, Range(0, 180, unit="degrees", open_low=True, open_high=True)]
Above0 = Annotated[float, Range(0, LARGEST_NUMBER, open_low=True)]
OptionalTime = Optional[Annotated[float, Range()]]  # noqa: UP045  at run time, on Python 3.9 too


def for_size(camera: Camera, width: int, height: int) -> Camera:
    """The camera for images of another size: scaled to fill them, cut alike on both sides, never stretched."""
    if (width, height) == (camera.width, camera.height):
        return camera
    old, new = np.array([camera.width, camera.height]), np.array([width, height])
    scale, K = (new / old).max(), camera.K.copy()
    K[:2, :2] *= scale
    K[:2, 2] = (K[:2, 2] - old / 2) * scale + new / 2
    return replace(camera, width=width, height=height, K=K)


def at_pose(camera: Camera, T_camera_world: np.ndarray) -> Camera:
    """The camera at another place, where it is none of the recording's and has no name."""
    return replace(camera, name="", T_camera_world=T_camera_world)


def orbit(
    cameras: Sequence[Camera], count: int, degrees: float | None = None, depth: float | None = None
) -> list[Camera]:
    """A swing around the point that the cameras look at, from its middle to both ends and back; a whole turn for 360.

    It swings by `degrees`, by default the angle that the cameras span, or a whole turn where they stand all around.
    `depth` is that of what is looked at, in front of the cameras, where their axes do not meet.
    """
    rig = Rig.of(cameras, depth)
    span = rig.span if degrees is None else degrees
    if degrees is None:
        span = 360.0 if span > ALL_AROUND else max(span, LEAST_SWING)
    share = np.arange(count) / max(count, 1)
    angles = 360 * share if span >= 360 else span / 2 * np.sin(2 * np.pi * share)
    start = rig.middle - rig.focus
    around = [rotation_of_vector(np.radians(angle) * rig.up) @ start for angle in angles]
    return [at_pose(cameras[0], look_at(rig.focus + offset, rig.focus, rig.up)) for offset in around]


class Rig(NamedTuple):
    """What cameras have in common."""

    focus: np.ndarray  # [3], what they look at
    middle: np.ndarray  # [3], where a camera between them stands
    up: np.ndarray  # [3], unit
    span: float  # degrees

    @classmethod
    def of(cls, cameras: Sequence[Camera], depth: float | None) -> Rig:
        """Of one camera or more; `depth` is that of what they look at, where their axes do not meet."""
        centres = np.stack([camera.centre for camera in cameras])
        forwards = np.stack([camera.T_camera_world[2, :3] for camera in cameras])
        up = unit(-np.mean([camera.T_camera_world[1, :3] for camera in cameras], axis=0))
        focus = focus_of(centres, forwards, depth)
        offsets = centres - focus
        flat = offsets - np.outer(offsets @ up, up)
        azimuth, span = _arc(flat, up)
        radius, height = np.linalg.norm(flat, axis=1).mean(), (offsets @ up).mean()
        towards = rotation_of_vector(np.radians(azimuth) * up) @ unit(flat[0])
        return cls(focus, focus + radius * towards + height * up, up, span)

    @property
    def home(self) -> np.ndarray:
        """T_camera_world [4, 4] in front of what the cameras look at, between them."""
        return look_at(self.middle, self.focus, self.up)

    def limits(self, cameras: Sequence[Camera]) -> dict[str, list[float] | None]:
        """Ends of where cameras stood, with a margin: azimuth about `up` (radians, 0 at home; None where they stand all
        around), elevation (radians) and distance from the focus."""
        offsets, home = np.stack([camera.centre for camera in cameras]) - self.focus, self.middle - self.focus
        ahead = unit(home - (home @ self.up) * self.up)
        azimuth = np.arctan2(offsets @ np.cross(self.up, ahead), offsets @ ahead)
        distance = np.linalg.norm(offsets, axis=1)
        elevation = np.arcsin(np.clip(offsets @ self.up / distance, -1, 1))
        margin = np.radians([-MARGIN, MARGIN])
        return {
            "azimuth": None if self.span > ALL_AROUND else ([azimuth.min(), azimuth.max()] + margin).tolist(),
            "elevation": np.clip([elevation.min(), elevation.max()] + margin, -1.5, 1.5).tolist(),
            "distance": [NEAREST * float(distance.min()), FARTHEST * float(distance.max())],
        }


def _arc(flat: np.ndarray, up: np.ndarray) -> tuple[float, float]:
    """Middle and width, in degrees, of the arc about `up` on which the cameras stand; 0 degrees is the first camera.

    It is the circle without the widest gap between two neighbours.
    """
    ahead = unit(flat[0])
    angles = np.sort(np.degrees(np.arctan2(flat @ np.cross(up, ahead), flat @ ahead)))
    gaps = np.diff(angles, append=angles[0] + 360)
    begin = int(gaps.argmax()) + 1
    span = 360 - float(gaps.max())
    return float(angles[begin % len(angles)]) + span / 2, span


def between(chain: Sequence[Camera], place: float) -> Camera:
    """The pose at `place` of a chain: whole numbers are its cameras."""
    first = min(int(place), len(chain) - 1)
    share = place - first
    if share == 0:
        return at_pose(chain[first], chain[first].T_camera_world)
    share = share * share * (3 - 2 * share)  # slow at both ends
    a, b = chain[first], chain[first + 1]
    p, q = (quaternion_of_rotation(camera.T_camera_world[:3, :3]) for camera in (a, b))
    q = q if p @ q >= 0 else -q
    angle = np.arccos(np.clip(p @ q, -1, 1))
    weights = (1 - share, share) if angle < 1e-6 else np.sin([(1 - share) * angle, share * angle]) / np.sin(angle)
    R = rotation_of_quaternion(weights[0] * p + weights[1] * q)
    K = (1 - share) * a.K + share * for_size(b, a.width, a.height).K
    return replace(at_pose(a, rigid(R, -R @ ((1 - share) * a.centre + share * b.centre))), K=K)


class CameraPath(NamedTuple):
    """What a camera_path.json says."""

    cameras: list[Camera]
    shares: list[float] | None
    """The instant of each camera, 0 first and 1 last of the recording; None where the file leaves time to run."""
    fps: float


def read_camera_path(path: Path) -> CameraPath:
    """Read nerfstudio's camera_path.json.

    Raises:
        D2Error: not such a file, an empty path, or a camera that is not a perspective one.
    """
    try:
        table = read_json(path, EXPORT)
    except NoSuchFile:
        raise D2Error(f"no camera path at {path}: give orbit, held-out, training or a file") from None
    kind, place = table.get("camera_type", "perspective"), str(path)
    if kind != "perspective":
        raise D2Error(f"{path} is for a camera of type {str(kind)[:40]!r}, expected perspective: export it as that")
    size = field(table, "render_width", Side, place, EXPORT), field(table, "render_height", Side, place, EXPORT)
    entries = field(table, "camera_path", list, place, EXPORT)
    if not entries:
        raise D2Error(f"the camera path {path} has no camera: add keyframes and {EXPORT}")
    cameras, times = [], []
    for number, entry in enumerate(entries):
        where = f"camera {number} of {path}"
        if not isinstance(entry, dict):
            raise D2Error(f"{where} is no object: {EXPORT}")
        T_world_camera = numbers(entry, "camera_to_world", (4, 4), where, EXPORT)
        focal = size[1] / 2 / np.tan(np.radians(field(entry, "fov", Vertical, where, EXPORT)) / 2)
        R = T_world_camera[:3, :3].T  # whether it is a rotation is checked of the camera that comes of it
        pose = OPENGL_TO_OPENCV @ rigid(R, -R @ T_world_camera[:3, 3])
        K = pinhole(focal, focal, size[0] / 2, size[1] / 2)
        cameras.append(replace(checked_camera(str(number), size, K, pose, None, place), name=""))
        times.append(field(entry, "render_time", OptionalTime, where, EXPORT, default=None))
    known = [float(np.clip(time, 0, 1)) for time in times if time is not None]
    if table.get("seconds") or not table.get("fps"):  # as nerfstudio's renderer has it
        fps = len(cameras) / (field(table, "seconds", Above0, place, EXPORT) if table.get("seconds") else 1.0)
    else:
        fps = field(table, "fps", Above0, place, EXPORT)
    return CameraPath(cameras, known if len(known) == len(times) else None, fps)


def camera_path_text(cameras: Sequence[Camera], shares: Sequence[float], fps: float) -> str:
    """nerfstudio's camera_path.json of cameras of one size in the world of the recording; see `CameraPath`."""
    entries = []
    for camera, share in zip(cameras, shares, strict=True):
        world = np.linalg.inv(camera.T_camera_world) @ OPENGL_TO_OPENCV
        fov = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1])))
        entries.append({"camera_to_world": world.flatten().tolist(), "fov": fov, "render_time": share})
    size = {"render_width": cameras[0].width, "render_height": cameras[0].height} if cameras else {}
    return json_text(size | {"fps": fps, "seconds": len(entries) / fps, "camera_path": entries}, "the camera path")

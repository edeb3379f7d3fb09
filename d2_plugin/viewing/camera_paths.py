"""Camera paths: a camera's pose and lens for each image of a video, made from the cameras of a recording or read.

All poses are `T_camera_world` [4, 4] float64 in OpenCV axes. Two to four cameras cover a small part of the sphere
around a scene, and what they did not see cannot be shown: orbit and spiral stay inside the angle that they span.

`read_camera_path` reads nerfstudio's camera_path.json, as its viewer and others write it. There poses are
camera-to-world in OpenGL axes (x right, y up, z back), the field of view is vertical and in degrees. The path must be
in the world of the recording: a `dataparser_transforms.json` beside it, with which nerfstudio turned and scaled that
world, is undone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Optional

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import NoSuchFile, field, read_json
from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.camera import (
    LARGEST_NUMBER,
    LARGEST_SIDE,
    OPENGL_TO_OPENCV,
    checked_camera,
    pinhole,
    rigid,
)
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation, rotation_of_quaternion, rotation_of_vector
from d2_plugin.values import Range

ALL_AROUND = 270.0
"""Cameras that span more than this many degrees stand all around: an orbit is then a whole turn."""
LEAST_SWING = 12.0
"""Degrees that an orbit swings at least, where cameras stand close together."""

EXPORT = "export the camera path again"

Side = Annotated[int, Range(1, LARGEST_SIDE, unit="pixels")]
Vertical = Annotated[float, Range(0, 180, unit="degrees", open_low=True, open_high=True)]
Above0 = Annotated[float, Range(0, LARGEST_NUMBER, open_low=True)]
OptionalTime = Optional[Annotated[float, Range()]]  # noqa: UP045  at run time, on Python 3.9 too


class Lens(NamedTuple):
    """Intrinsics and the size they belong to."""

    K: np.ndarray  # [3, 3]
    width: int
    height: int

    def fitted(self, width: int, height: int) -> Lens:
        """The lens for images of another size: scaled to fill them, cut alike on both sides, never stretched."""
        if (width, height) == (self.width, self.height):
            return self
        scale = max(width / self.width, height / self.height)
        K = self.K.copy()
        K[:2, :2] *= scale
        K[:2, 2] = (K[:2, 2] - np.array([self.width, self.height]) / 2) * scale + np.array([width, height]) / 2
        return Lens(K, width, height)


class Pose(NamedTuple):
    """One camera of a path."""

    T_camera_world: np.ndarray
    lens: Lens


def pose_of(camera: Camera) -> Pose:
    """Where a camera of a recording stands."""
    return Pose(camera.T_camera_world, Lens(camera.K, camera.width, camera.height))


def orbit(
    cameras: Sequence[Camera], count: int, degrees: float | None = None, depth: float | None = None
) -> list[Pose]:
    """A swing around the point that the cameras look at, from its middle to both ends and back; a whole turn for 360.

    Args:
        cameras: those of the recording.
        count: of poses.
        degrees: angle of the swing; by default the angle that the cameras span, or a whole turn where they stand all
            around.
        depth: of what is looked at, in front of the cameras, where their axes do not meet.
    """
    rig = _Rig.of(cameras, depth)
    span = rig.span if degrees is None else degrees
    if degrees is None:
        span = 360.0 if span > ALL_AROUND else max(span, LEAST_SWING)
    share = np.arange(count) / max(count, 1)
    angles = 360 * share if span >= 360 else span / 2 * np.sin(2 * np.pi * share)
    start = rig.middle - rig.focus
    around = [rotation_of_vector(np.radians(angle) * rig.up) @ start for angle in angles]
    return [Pose(look_at(rig.focus + offset, rig.focus, rig.up), rig.lens) for offset in around]


def spiral(cameras: Sequence[Camera], count: int, depth: float | None = None) -> list[Pose]:
    """LLFF's spiral of two turns about the mean camera, looking at the point that the cameras look at.

    Its radii are half of the 90th percentile of the cameras' distances from their mean, along each axis: the whole
    of it would leave what an arc of few cameras has seen.
    """
    rig = _Rig.of(cameras, depth)
    axes = look_at(rig.middle, rig.focus, rig.up)[:3, :3]
    offsets = np.abs((np.stack([camera.centre for camera in cameras]) - rig.middle) @ axes.T)
    radii = 0.5 * np.percentile(offsets, 90, axis=0)
    radii = np.maximum(radii, 0.02 * np.linalg.norm(rig.focus - rig.middle) * np.array([1, 1, 0]))
    angle = 4 * np.pi * np.arange(count) / max(count, 1)
    local = np.stack([np.sin(angle), np.cos(angle) - 1, np.sin(angle / 2)], -1) * radii
    return [Pose(look_at(rig.middle + offset @ axes, rig.focus, rig.up), rig.lens) for offset in local]


def through(cameras: Sequence[Camera], count: int) -> list[Pose]:
    """From camera to camera, each the nearest that is left: the first pose is the first camera, the last the last.

    Positions, rotations and lenses are interpolated; the path rests at each camera for a moment.
    """
    chain = _chained(cameras)
    places = np.linspace(0, len(chain) - 1, count) if count > 1 else np.zeros(1)
    return [_between(chain, place) for place in places]


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """T_camera_world [4, 4] of a camera at `position` that looks at `target`, upright."""
    forward = _unit(target - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any side will do
        right = np.cross(forward, np.roll(up, 1))
    right = _unit(right)
    R = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ position
    return T


class _Rig(NamedTuple):
    """What the cameras have in common."""

    focus: np.ndarray  # [3], what they look at
    middle: np.ndarray  # [3], where a camera between them stands
    up: np.ndarray  # [3], unit
    span: float  # degrees
    lens: Lens

    @classmethod
    def of(cls, cameras: Sequence[Camera], depth: float | None) -> _Rig:
        centres = np.stack([camera.centre for camera in cameras])
        forwards = np.stack([camera.T_camera_world[2, :3] for camera in cameras])
        up = _unit(-np.mean([camera.T_camera_world[1, :3] for camera in cameras], axis=0))
        focus = focus_of(centres, forwards, depth)
        offsets = centres - focus
        flat = offsets - np.outer(offsets @ up, up)
        azimuth, span = _arc(flat, up)
        radius, height = np.linalg.norm(flat, axis=1).mean(), (offsets @ up).mean()
        towards = rotation_of_vector(np.radians(azimuth) * up) @ _unit(flat[0])
        first = cameras[0]
        return cls(focus, focus + radius * towards + height * up, up, span, Lens(first.K, first.width, first.height))


def focus_of(centres: np.ndarray, forwards: np.ndarray, depth: float | None = None) -> np.ndarray:
    """The point nearest to all optical axes; `depth` in front of the mean camera where they do not meet before them."""
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # projections across each axis
    normal, right = across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0]
    eigenvalues = np.linalg.eigvalsh(normal)
    if eigenvalues[0] > 1e-4 * len(centres):
        point = np.linalg.solve(normal, right)
        if ((point - centres) * forwards).sum(axis=1).min() > 0:
            return point
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    far = depth if depth is not None else max(4 * spread, 1.0)
    return centres.mean(axis=0) + far * _unit(forwards.mean(axis=0))


def _arc(flat: np.ndarray, up: np.ndarray) -> tuple[float, float]:
    """Middle and width, in degrees, of the arc about `up` on which the cameras stand; 0 degrees is the first camera.

    It is the circle without the widest gap between two neighbours.
    """
    ahead = _unit(flat[0])
    angles = np.sort(np.degrees(np.arctan2(flat @ np.cross(up, ahead), flat @ ahead)))
    gaps = np.diff(angles, append=angles[0] + 360)
    begin = int(gaps.argmax()) + 1
    span = 360 - float(gaps.max())
    return float(angles[begin % len(angles)]) + span / 2, span


def _chained(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras in an order of small steps, begun at an end of the rig: the camera farthest from their mean."""
    centres = np.stack([camera.centre for camera in cameras])
    at = int(np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmax())
    order, left = [at], set(range(len(cameras))) - {at}
    while left:
        at = min(left, key=lambda i: float(np.linalg.norm(centres[i] - centres[order[-1]])))
        order.append(at)
        left.remove(at)
    return [cameras[i] for i in order]


def _between(chain: Sequence[Camera], place: float) -> Pose:
    """The pose at `place` of a chain: whole numbers are its cameras."""
    first = min(int(place), len(chain) - 1)
    share = place - first
    if share == 0:
        return pose_of(chain[first])
    share = share * share * (3 - 2 * share)  # slow at both ends
    a, b = chain[first], chain[first + 1]
    p, q = (quaternion_of_rotation(camera.T_camera_world[:3, :3]) for camera in (a, b))
    q = q if p @ q >= 0 else -q
    angle = np.arccos(np.clip(p @ q, -1, 1))
    weights = (1 - share, share) if angle < 1e-6 else np.sin([(1 - share) * angle, share * angle]) / np.sin(angle)
    T = np.eye(4)
    T[:3, :3] = rotation_of_quaternion(weights[0] * p + weights[1] * q)
    T[:3, 3] = -T[:3, :3] @ ((1 - share) * a.centre + share * b.centre)
    end = Lens(b.K, b.width, b.height).fitted(a.width, a.height)
    return Pose(T, Lens((1 - share) * a.K + share * end.K, a.width, a.height))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.linalg.norm(vector), 1e-12)


class CameraPath(NamedTuple):
    """What a camera_path.json says."""

    poses: list[Pose]
    shares: list[float] | None
    """The instant of each pose, 0 first and 1 last of the recording; None where the file leaves time to run."""
    fps: float


def read_camera_path(path: Path) -> CameraPath:
    """Read nerfstudio's camera_path.json.

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
    size = field(table, "render_width", Side, str(path), EXPORT), field(table, "render_height", Side, str(path), EXPORT)
    entries = field(table, "camera_path", list, str(path), EXPORT)
    if not entries:
        raise D2Error(f"the camera path {path} has no camera: add keyframes and {EXPORT}")
    dataparser = _dataparser(path.parent / "dataparser_transforms.json")
    poses, times = [], []
    for number, entry in enumerate(entries):
        place = f"camera {number} of {path}"
        if not isinstance(entry, Mapping):
            raise D2Error(f"{place} is no object: {EXPORT}")
        poses.append(_pose(entry, size, dataparser, number, path))
        times.append(field(entry, "render_time", OptionalTime, place, EXPORT, default=None))
    known = [float(np.clip(time, 0, 1)) for time in times if time is not None]
    if table.get("fps"):
        fps = field(table, "fps", Above0, str(path), EXPORT)
    else:
        fps = len(poses) / (field(table, "seconds", Above0, str(path), EXPORT) if table.get("seconds") else 1.0)
    return CameraPath(poses, known if len(known) == len(times) else None, fps)


def _pose(
    entry: Mapping[str, Any], size: tuple[int, int], dataparser: tuple[np.ndarray, float], number: int, path: Path
) -> Pose:
    place = f"camera {number} of {path}"
    to_nerfstudio, scale = dataparser
    T_world_camera = _matrix(entry, "camera_to_world", 4, place)
    T_world_camera[:3, 3] /= scale
    focal = size[1] / 2 / np.tan(np.radians(field(entry, "fov", Vertical, place, EXPORT)) / 2)
    T_camera_world = OPENGL_TO_OPENCV @ _inverse(T_world_camera) @ to_nerfstudio
    K = pinhole(focal, focal, size[0] / 2, size[1] / 2)
    return pose_of(checked_camera(str(number), size, K, T_camera_world, None, str(path)))


def _dataparser(path: Path) -> tuple[np.ndarray, float]:
    """From the recording's world to nerfstudio's, [4, 4], and the scale that positions there were multiplied by."""
    if not path.is_file():
        return np.eye(4), 1.0
    table = read_json(path, EXPORT)
    return _matrix(table, "transform", 3, str(path)), field(table, "scale", Above0, str(path), EXPORT)


def _matrix(table: Mapping[str, Any], name: str, rows: int, place: str) -> np.ndarray:
    """The pose under `name`, [4, 4], from the first `rows` rows of 4 numbers, nested or not."""
    values = field(table, name, list, place, EXPORT)
    found = np.eye(4)
    try:
        found[:rows] = np.array(values, np.float64).reshape(rows, 4)
    except (TypeError, ValueError, OverflowError):
        raise D2Error(f"{name} of {place} is no matrix of {rows} x 4 numbers: {EXPORT}") from None
    if not (np.abs(found) <= LARGEST_NUMBER).all():
        raise D2Error(f"{name} of {place} has a number that is not finite or too large: {EXPORT}")
    if not np.array_equal(found[3], (0, 0, 0, 1)):
        raise D2Error(f"{name} of {place} ends in {found[3].tolist()}, expected 0, 0, 0, 1: {EXPORT}")
    return found


def _inverse(T: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform; whether it is rigid is checked of the camera that it gives."""
    return rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])

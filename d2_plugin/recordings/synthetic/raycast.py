"""Exact ray casting of boxes and spheres in a closed room, in numpy: colours with shadows, and planar depth.

Directions are scaled to z = 1 in the camera, so that the distance along a ray *is* the planar depth. Vectors are stored
component first, [3, R] for R rays: numpy reduces over a short first axis several times faster than over a last one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.materials import sample

Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]  # seconds -> (rotation [3, 3] object to world, centre [3])
SHADOW_BIAS = 1e-6  # shadow rays start this fraction of the way to the light, so that no surface shades itself


@dataclass(frozen=True, eq=False)
class Solid:
    """A box (`half_size` [3]) or, where `radius` is given, a sphere, with a texture and a motion."""

    motion: Motion
    texture: np.ndarray
    half_size: np.ndarray
    radius: float | None = None
    repeat: float = 1.0  # world units per texture repeat (boxes); spheres wrap their texture around once

    @property
    def reach(self) -> float:
        """Radius of the bounding sphere."""
        return float(np.linalg.norm(self.half_size)) if self.radius is None else self.radius


@dataclass(frozen=True, eq=False)
class Room:
    """A box seen from inside: `low` and `high` corners, and one texture per axis and side [3][2]."""

    low: np.ndarray
    high: np.ndarray
    textures: tuple[tuple[np.ndarray, np.ndarray], ...]
    repeat: float = 2.0


@dataclass(frozen=True, eq=False)
class Scene:
    """A room with solids, lit by an ambient part and four point lights (one per sub-pixel: a soft shadow's edge)."""

    room: Room
    solids: tuple[Solid, ...]
    lights: np.ndarray  # [4, 3]
    ambient: float = 0.42
    direct: float = 0.75


def render_color(scene: Scene, camera: Camera, seconds: float) -> np.ndarray:
    """RGB uint8 [H, W, 3], the mean of four rays per pixel."""
    offsets = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
    shaded = [_shaded(scene, camera, seconds, offset, light) for offset, light in zip(offsets, scene.lights)]
    total = np.sum(shaded, axis=0)
    mean = total.reshape(3, camera.height, camera.width).transpose(1, 2, 0) / len(offsets)
    return np.ascontiguousarray(np.clip(np.rint(mean * 255), 0, 255).astype(np.uint8))


def render_depth(scene: Scene, camera: Camera, seconds: float) -> np.ndarray:
    """Exact planar z float32 [H, W] at the pixel centres."""
    distance, _ = first_hits(scene, camera, directions_of(camera, (0.5, 0.5)), seconds)
    return distance.reshape(camera.height, camera.width).astype(np.float32)


def directions_of(camera: Camera, offset: tuple[float, float]) -> np.ndarray:
    """World directions [3, H * W] with camera z = 1 through the point `offset` of every pixel."""
    x = (np.arange(camera.width) + offset[0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (np.arange(camera.height) + offset[1] - camera.K[1, 2]) / camera.K[1, 1]
    right, down, forward = camera.T_camera_world[:3, :3, None, None]
    return (right * x + down * y[:, None] + forward).reshape(3, -1)


def first_hits(scene: Scene, camera: Camera, directions: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """(distance [R] in lengths of `directions` [3, R], index of the solid met first [R], -1 for the room)."""
    walls = np.where(directions > 0, scene.room.high[:, None], scene.room.low[:, None]) - camera.centre[:, None]
    with np.errstate(divide="ignore"):
        distance = np.where(directions == 0, np.inf, walls / directions).min(axis=0)
    owner = np.full(distance.shape, -1)
    for index, solid in enumerate(scene.solids):
        rays = _candidates(camera, solid, seconds)
        reached = _distances(solid, camera.centre[:, None], directions[:, rays], seconds)
        nearer = reached < distance[rays]
        distance[rays[nearer]] = reached[nearer]
        owner[rays[nearer]] = index
    return distance, owner


def _candidates(camera: Camera, solid: Solid, seconds: float) -> np.ndarray:
    """Flat indices of a rectangle of pixels that surely holds the whole solid."""
    _, centre = solid.motion(seconds)
    x, y, z = camera.T_camera_world[:3, :3] @ centre + camera.T_camera_world[:3, 3]
    rows, columns = slice(0, camera.height), slice(0, camera.width)
    if z > 1.5 * solid.reach:
        columns = _span(camera.K[0, 0], camera.K[0, 2], x, z, solid.reach, camera.width)
        rows = _span(camera.K[1, 1], camera.K[1, 2], y, z, solid.reach, camera.height)
    pixels = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)
    return pixels[rows, columns].ravel()


def _span(focal: float, principal: float, offset: float, z: float, reach: float, size: int) -> slice:
    """Pixels along one axis that a sphere covers: the direction to its centre, plus and minus its angular radius."""
    angle, spread = np.arctan2(offset, z), np.arcsin(reach / np.hypot(offset, z))
    low, high = (focal * np.tan(np.clip(angle + side * spread, -1.5, 1.5)) + principal for side in (-1, 1))
    return slice(int(np.clip(np.floor(low) - 1, 0, size)), int(np.clip(np.ceil(high) + 1, 0, size)))


def _distances(solid: Solid, origins: np.ndarray, directions: np.ndarray, seconds: float) -> np.ndarray:
    """Distance [R] along each ray to the solid's outside, infinite where it is missed or behind."""
    rotation, centre = solid.motion(seconds)
    origins, directions = rotation.T @ (origins - centre[:, None]), rotation.T @ directions
    if solid.radius is not None:
        return _sphere_distances(solid.radius, origins, directions)
    half_size = solid.half_size[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half_size - origins) / directions, (half_size - origins) / directions
    enter, leave = np.minimum(first, second).max(axis=0), np.maximum(first, second).min(axis=0)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def _sphere_distances(radius: float, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    squared, half_b = _dot(directions, directions), _dot(origins, directions)
    discriminant = half_b * half_b - squared * (_dot(origins, origins) - radius * radius)
    nearest = (-half_b - np.sqrt(np.maximum(discriminant, 0))) / squared
    return np.where((discriminant > 0) & (nearest > 0), nearest, np.inf)


def _shaded(scene: Scene, camera: Camera, seconds: float, offset: tuple[float, float], light: np.ndarray) -> np.ndarray:
    """Colours [3, R] of one ray per pixel."""
    directions = directions_of(camera, offset)
    distance, owner = first_hits(scene, camera, directions, seconds)
    points = camera.centre[:, None] + distance * directions
    albedo, normals = np.empty_like(points), np.empty_like(points)
    for index in range(-1, len(scene.solids)):
        rays = np.flatnonzero(owner == index)
        if index < 0:
            albedo[:, rays], normals[:, rays] = _room_surface(scene.room, points[:, rays])
        else:
            albedo[:, rays], normals[:, rays] = _surface(scene.solids[index], points[:, rays], seconds)
    to_light = light[:, None] - points
    squared = _dot(to_light, to_light)
    cosine = np.maximum(_dot(normals, to_light), 0) / np.sqrt(squared)
    return albedo * (scene.ambient + scene.direct * cosine * _visible(scene, points, to_light, squared, seconds))


def _visible(scene: Scene, points: np.ndarray, to_light: np.ndarray, squared: np.ndarray, seconds: float) -> np.ndarray:
    """Whether nothing stands between each point and the light [R]; `squared` is the squared distance to the light."""
    visible = np.ones(squared.shape, bool)
    for solid in scene.solids:
        # Only segments that come near the bounding sphere can be cut off by the solid.
        offset = solid.motion(seconds)[1][:, None] - points
        along = _dot(offset, to_light)
        beside = _dot(offset, offset) * squared - along * along
        rays = np.flatnonzero(visible & (beside <= solid.reach**2 * squared))
        start = points[:, rays] + SHADOW_BIAS * to_light[:, rays]
        visible[rays] = _distances(solid, start, to_light[:, rays], seconds) >= 1
    return visible


def _room_surface(room: Room, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo [3, R], inward normals [3, R]) of points on the room's walls."""
    gaps = np.concatenate([points - room.low[:, None], room.high[:, None] - points])
    wall = gaps.argmin(axis=0)
    albedo, normals = np.empty_like(points), np.zeros_like(points)
    for number in range(6):
        axis, side = number % 3, number // 3
        on = np.flatnonzero(wall == number)
        across = points[:, on][[other for other in range(3) if other != axis]]
        albedo[:, on] = sample(room.textures[axis][side], across / room.repeat)
        normals[axis, on] = 1 - 2 * side
    return albedo, normals


def _surface(solid: Solid, points: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """(albedo [3, R], outward world normals [3, R]) of points on a solid."""
    rotation, centre = solid.motion(seconds)
    local = rotation.T @ (points - centre[:, None])
    if solid.radius is not None:
        normals = local / solid.radius
        longitude = np.arctan2(normals[1], normals[0]) / (2 * np.pi)
        latitude = np.arccos(np.clip(normals[2], -1, 1)) / np.pi
        return sample(solid.texture, np.stack([longitude, latitude])), rotation @ normals
    axis = np.abs(local / solid.half_size[:, None]).argmax(axis=0)
    rays = np.arange(axis.size)
    normals = np.zeros_like(local)
    normals[axis, rays] = np.sign(local[axis, rays])
    # Of a face's two coordinates the texture runs down along z where there is z.
    across, up = np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)
    uv = np.stack([local[across, rays] + solid.half_size[across], solid.half_size[up] - local[up, rays]])
    return sample(solid.texture, uv / solid.repeat), rotation @ normals


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

"""Two-view geometry of calibrated pinhole cameras, in array indices.

A recording's intrinsics place the centre of pixel i at i + 0.5. Resampling kernels (OpenCV, our own) address arrays,
where that pixel is simply i. Everything in this file is in array indices; `index_intrinsics` is the one place where
the half pixel is taken off. For a reference pixel p = (u, v, 1) at inverse depth q the source pixel is

    p' ~ A p + k q,     A = K_s R K_r^-1,  k = K_s t,     (R, t) maps reference to source camera,

so a plane sweep or an inverse-depth plane costs one homography each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.recording import Camera

CONTINUOUS = 1.1
"""Four neighbours of a map whose depths differ by a larger factor are no surface."""


class Projection(NamedTuple):
    """Where reference pixels land in a source: array indices `x`, `y` and view depth `z` (all NaN-free; test z > 0)."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Homography parts from a reference to a source camera; `direction` is the source centre seen by the reference."""

    A: np.ndarray  # [3, 3] float64, K_s R K_r^-1
    k: np.ndarray  # [3] float64, K_s t
    direction: np.ndarray  # [3] float64, source centre in reference camera coordinates, world units

    def project(self, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> Projection:
        """Reference pixels (u, v) at planar depth `depth` -> source indices and depth; behind the source z <= 0."""
        dtype = depth.dtype
        A, k = self.A.astype(dtype), self.k.astype(dtype)
        z = depth * (A[2, 0] * u + A[2, 1] * v + A[2, 2]) + k[2]
        safe = np.where(z > 0, z, np.inf).astype(dtype)
        x = (depth * (A[0, 0] * u + A[0, 1] * v + A[0, 2]) + k[0]) / safe
        y = (depth * (A[1, 0] * u + A[1, 1] * v + A[1, 2]) + k[1]) / safe
        return Projection(x, y, z)


def index_intrinsics(camera: Camera) -> np.ndarray:
    """K [3, 3] for array indices: the pixel whose centre the recording puts at (0.5, 0.5) is at (0, 0) here."""
    K = np.array(camera.K, dtype=np.float64)
    K[:2, 2] -= 0.5
    return K


def relative_pose(reference: Camera, source: Camera) -> np.ndarray:
    """T_source_reference [4, 4]: points in the reference camera's frame to the source camera's."""
    return source.T_camera_world @ np.linalg.inv(reference.T_camera_world)


def view_pair(reference: Camera, source: Camera) -> ViewPair:
    """The homography parts A and k from `reference` to `source`."""
    T = relative_pose(reference, source)
    K_s, K_r = index_intrinsics(source), index_intrinsics(reference)
    R, t = T[:3, :3], T[:3, 3]
    return ViewPair(K_s @ R @ np.linalg.inv(K_r), K_s @ t, -R.T @ t)


def pixel_grid(camera: Camera, dtype: type = np.float32) -> tuple[np.ndarray, np.ndarray]:
    """Index coordinates u [1, W] and v [H, 1], to be broadcast."""
    return np.arange(camera.width, dtype=dtype)[None, :], np.arange(camera.height, dtype=dtype)[:, None]


def viewing_rays(camera: Camera, dtype: type = np.float32) -> np.ndarray:
    """Directions [H, W, 3] with z = 1: the 3D point of a pixel is its depth times its ray, in camera coordinates."""
    u, v = pixel_grid(camera, np.float64)
    rays: np.ndarray = np.empty((camera.height, camera.width, 3), dtype)
    for axis, (across, down, offset) in enumerate(np.linalg.inv(index_intrinsics(camera))):
        rays[..., axis] = across * u + down * v + offset
    return rays


def seen_by(reference: Camera, source: Camera, grid: tuple[int, int], depths: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of a grid of the reference's pixels (across, down) at depths [D]: whether the source sees them, and the angle in
    degrees between both rays, [D, pixels]."""
    small = scaled_camera(reference, *grid)
    pair, maps = view_pair(small, source), np.broadcast_to(depths[:, None, None], (len(depths), *grid[::-1]))
    at = pair.project(*pixel_grid(small, np.float64), maps)
    inside = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < source.width - 0.5) & (at.y < source.height - 0.5)
    return inside.reshape(len(depths), -1), np.rad2deg(triangulation_angle(small, pair, maps)).reshape(len(depths), -1)


def triangulation_angle(camera: Camera, pair: ViewPair, depth: np.ndarray) -> np.ndarray:
    """Angle [..., H, W] in radians between the rays of both cameras at each pixel's 3D point; 0 for one centre."""
    unit = 2.0 ** -np.frexp(np.median(depth))[1]  # near 1 no square overflows, and a power of two changes no digit
    points = viewing_rays(camera) * (depth * np.float32(unit))[..., None]
    other = points - (pair.direction * unit).astype(np.float32)
    (x, y, z), (u, v, w) = np.moveaxis(points, -1, 0), np.moveaxis(other, -1, 0)
    cross = np.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
    # atan2 of (|a x b|, a.b) keeps its digits at small angles, where arccos of float32 has none below .03 degrees.
    return np.arctan2(cross, x * u + y * v + z * w)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera with an image of another size; with centres at i + 0.5 the intrinsics only scale."""
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return replace(camera, width=width, height=height, K=K)


def projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [K, 2] and planar depths [K] of world points [K, 3], and which of them the image holds."""
    in_camera = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    depths = in_camera[:, 2]
    front = depths > 0
    pixels = (in_camera @ camera.K.T)[:, :2] / np.where(front, depths, 1)[:, None]
    inside = (pixels >= 0).all(-1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return pixels, depths, front & inside

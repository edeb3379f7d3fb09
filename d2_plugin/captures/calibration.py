"""Numbers from a calibration file, checked before they become a `Camera`."""

from __future__ import annotations

import numpy as np

from d2_plugin.captures.capture import Camera
from d2_plugin.errors import D2Error

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z backward) to OpenCV's (y down, z forward), and back."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I that still counts as rounding in a text file."""

ASPECT_TOLERANCE = 0.01
"""Relative difference of horizontal and vertical scale that still counts as rounding of a size to whole pixels."""


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K [3, 3] float64 in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """T [4, 4] float64 from R [3, 3] and t [3]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def resized(K: np.ndarray, calibrated: tuple[int, int], pictures: tuple[int, int], name: str, where: str) -> np.ndarray:
    """K for pictures that are smaller or larger copies of the size (width, height) that was calibrated."""
    scale = np.array(pictures) / calibrated
    if abs(scale[1] - scale[0]) > ASPECT_TOLERANCE * scale[0]:
        raise D2Error(
            f"pictures of camera {name} are {pictures[0]}x{pictures[1]} but {where} says {calibrated[0]}x"
            f"{calibrated[1]}, another aspect: use pictures that are scaled, not cropped"
        )
    return np.diag([*scale, 1.0]) @ K


def checked_camera(
    name: str,
    size: tuple[int, int],
    K: np.ndarray,
    T_camera_world: np.ndarray,
    near_far: tuple[float, float] | None,
    where: str,
) -> Camera:
    """A `Camera` of `size` (width, height), or one sentence that says which number in the file `where` is wrong."""

    def refuse(problem: str) -> D2Error:
        return D2Error(f"camera {name} in {where} {problem}: correct the calibration")

    if not (np.isfinite(K).all() and np.isfinite(T_camera_world).all()):
        raise refuse("has a number that is not finite")
    if min(size) < 1:
        raise refuse(f"has the size {size[0]}x{size[1]}, expected at least one pixel")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise refuse(f"has focal lengths {K[0, 0]:g} and {K[1, 1]:g}, expected positive pixels")
    rotation = T_camera_world[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise refuse("has an R that is no rotation (orthonormal rows, determinant +1)")
    if near_far is not None and not (0 < near_far[0] < near_far[1] < np.inf):
        raise refuse(f"has depth bounds {near_far[0]:g} to {near_far[1]:g}, expected 0 < near < far")
    return Camera(name, size[0], size[1], K, T_camera_world, near_far)

"""Numbers from a calibration file, checked before they become a `Camera`."""

from __future__ import annotations

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import shown

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z backward) to OpenCV's (y down, z forward), and back."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I that still counts as rounding in a text file."""

ASPECT_TOLERANCE = 0.01
"""Relative difference of horizontal and vertical scale that still counts as rounding of a size to whole pixels."""

LARGEST_NUMBER = 1e9
"""Larger positions, depths and pixels are refused: float32, which everything is computed in, has 7 digits."""

LARGEST_SIDE = 65_535
"""Most pixels along a side, as JPEG has it."""

FIELD_OF_VIEW = (0.5, 178.0)
"""A camera that sees less or more than this, in degrees, is refused. What is unusual is noted, see `check`."""

MOST_OBLIQUE = 80.0
"""Degrees between a camera's axis and the middle of its image, at most: what is farther out is no principal point."""

FOCAL_RATIO = 4.0
"""fx and fy differ by less than this factor: anamorphic lenses reach 2."""

FRAME_RATES = (1e-6, 1e6)
"""Frames per second: from one in eleven days to a million."""

LONGEST_NAME = 100
"""Letters of a camera's name, which becomes a folder and part of file names."""


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K [3, 3] float64 in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """T [4, 4] float64 from R [3, 3] and t [3]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def resized(K: np.ndarray, calibrated: tuple[int, int], images: tuple[int, int], name: str, where: str) -> np.ndarray:
    """K for images that are smaller or larger copies of the size (width, height) that was calibrated."""
    if not all(1 <= length <= LARGEST_SIDE for length in (*calibrated, *images)):
        raise D2Error(
            f"camera {name} in {where} has the size {shown(calibrated[0])} x {shown(calibrated[1])}, expected 1 to "
            f"{LARGEST_SIDE} pixels: correct the calibration"
        )
    if not (np.abs(K) <= LARGEST_NUMBER).all():
        raise D2Error(
            f"camera {name} in {where} has a K with a number that is not finite or larger than {LARGEST_NUMBER:g}: "
            "correct the calibration"
        )
    scale = np.array(images) / calibrated
    if abs(scale[1] - scale[0]) > ASPECT_TOLERANCE * scale[0]:
        raise D2Error(
            f"images of camera {name} are {images[0]}x{images[1]} but {where} says {calibrated[0]}x"
            f"{calibrated[1]}, another aspect: use images that are scaled, not cropped"
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

    check_name(name, where)
    if not (np.isfinite(K).all() and np.isfinite(T_camera_world).all()):
        raise refuse("has a number that is not finite")
    if min(size) < 1:
        raise refuse(f"has the size {shown(size[0])}x{shown(size[1])}, expected at least one pixel")
    if max(size) > LARGEST_SIDE:
        raise refuse(f"has the size {shown(size[0])}x{shown(size[1])}, expected at most {LARGEST_SIDE} pixels a side")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise refuse(f"has focal lengths {K[0, 0]:g} and {K[1, 1]:g}, expected positive pixels")
    largest = max(np.abs(K[:2]).max(), np.abs(T_camera_world).max())
    if largest > LARGEST_NUMBER:
        raise refuse(f"has the number {largest:g}, expected pixels and positions of at most {LARGEST_NUMBER:g} in size")
    if max(K[0, 0], K[1, 1]) > FOCAL_RATIO * min(K[0, 0], K[1, 1]):
        raise refuse(f"has focal lengths {K[0, 0]:g} and {K[1, 1]:g}, expected nearly the same")
    across, down = field_of_view(K, size)
    if max(across, down) < FIELD_OF_VIEW[0] or max(across, down) > FIELD_OF_VIEW[1]:
        raise refuse(
            f"sees {across:.3g} x {down:.3g} degrees, expected {FIELD_OF_VIEW[0]:g} to {FIELD_OF_VIEW[1]:g} "
            "(are the focal lengths in pixels of these images?)"
        )
    oblique = off_axis(K, size)
    if oblique > MOST_OBLIQUE:
        raise refuse(
            f"has its principal point at ({K[0, 2]:g}, {K[1, 2]:g}), {oblique:.1f} degrees from the middle of the "
            f"image, expected at most {MOST_OBLIQUE:g}"
        )
    rotation = T_camera_world[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise refuse("has an R that is no rotation (orthonormal rows, determinant +1)")
    if near_far is not None and not (1 / LARGEST_NUMBER < near_far[0] < near_far[1] < LARGEST_NUMBER):
        raise refuse(f"has depth bounds {near_far[0]:g} to {near_far[1]:g}, expected 0 < near < far")
    return Camera(name, size[0], size[1], K, T_camera_world, near_far)


def field_of_view(K: np.ndarray, size: tuple[int, int]) -> tuple[float, float]:
    """What a camera sees across and down, degrees, wherever its principal point lies."""
    edges = np.array([[0.0, 0.0], size])
    angles = np.arctan2(edges - K[:2, 2], K[[0, 1], [0, 1]])
    across, down = np.rad2deg(angles[1] - angles[0])
    return float(across), float(down)


def off_axis(K: np.ndarray, size: tuple[int, int]) -> float:
    """Angle between a camera's axis and the ray through the middle of its image, degrees."""
    middle = (np.array(size) / 2 - K[:2, 2]) / K[[0, 1], [0, 1]]
    return float(np.rad2deg(np.arctan(np.hypot(*middle))))


def check_name(name: str, where: str) -> None:
    """Refuse a camera's name that cannot be a folder of a prior or cannot be typed among others."""
    unfit = not name or name != name.strip() or name in (".", "..") or len(name) > LONGEST_NAME
    wrong = [letter for letter in name if letter in "/\\," or not letter.isprintable()]
    if unfit or wrong:
        why = f"holds {shown(wrong[0])}" if wrong else "is empty, a dot, too long, or has a space at an end"
        raise D2Error(
            f"the camera name {shown(name)} in {where} {why}: rename it, since names become folders and are joined by "
            "commas"
        )


def checked_rate(fps: float, where: str) -> float:
    """A frame rate, per second, or the sentence that it is none."""
    if not FRAME_RATES[0] <= fps <= FRAME_RATES[1]:
        raise D2Error(
            f"{where} says fps {fps:g}, expected frames per second above 0, from {FRAME_RATES[0]:g} to "
            f"{FRAME_RATES[1]:g}: correct the rate or the times"
        )
    return float(fps)

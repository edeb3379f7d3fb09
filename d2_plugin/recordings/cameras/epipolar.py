"""Features of images, and where the calibration of two cameras lets one see what the other sees."""

from __future__ import annotations

import numpy as np

from d2_plugin.recordings.images import checked_image, opencv
from d2_plugin.recordings.recording import Camera

OPENCVS_CONTRAST = 0.04  # of a SIFT feature, at least


def sift_features(
    image: np.ndarray, most: int, purpose: str, contrast: float = OPENCVS_CONTRAST, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(pixels [n, 2] with centres at i + 0.5, descriptors [n, 128], (size in pixels, angle in radians) [n, 2]).

    Args:
        image: RGB uint8 [H, W, 3].
        most: features, those of the highest contrast.
        purpose: what needs OpenCV, in the sentence that says where it is missing.
        contrast: of a feature, at least.
        mask: bool [H, W], where features may lie.
    """
    cv2 = opencv(purpose, "calibration")
    grey = cv2.cvtColor(checked_image(image, "the image of a camera"), cv2.COLOR_RGB2GRAY)
    # Without `enable_precise_upscale` OpenCV's SIFT is a quarter of a pixel too far right and down.
    sift = cv2.SIFT_create(most, contrastThreshold=contrast, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(grey, None if mask is None else mask.astype(np.uint8))
    pixels = np.array([point.pt for point in points]).reshape(-1, 2) + 0.5
    shapes = np.array([(point.size, np.deg2rad(point.angle)) for point in points]).reshape(-1, 2)
    return pixels, np.zeros((0, 128), np.float32) if descriptors is None else descriptors, shapes


def fundamental(one: Camera, other: Camera) -> np.ndarray:
    """F [3, 3] with q^T F p = 0 for pixels p of `one` and q of `other`."""
    relative = other.T_camera_world @ np.linalg.inv(one.T_camera_world)
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    product: np.ndarray = np.linalg.inv(other.K).T @ cross @ relative[:3, :3] @ np.linalg.inv(one.K)
    return product


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] with a third column of ones."""
    return np.column_stack([pixels, np.ones(len(pixels))])


def epipolar_lines(one: Camera, other: Camera, pixels: np.ndarray) -> np.ndarray:
    """Lines [n, 3] in `other` on which it sees what `one` sees at pixels [n, 2]; their product with a pixel is the
    distance."""
    lines = homogeneous(pixels) @ fundamental(one, other).T
    return lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True).clip(1e-300)


def sampson(one: Camera, other: Camera, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distance [n] in pixels, to first order, of pairs [n, 2] from the nearest that `one` and `other` allow."""
    F = fundamental(one, other)
    there, back = homogeneous(p) @ F.T, homogeneous(q) @ F
    squares = (there[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    distance: np.ndarray = np.abs((homogeneous(q) * there).sum(axis=1)) / np.sqrt(squares).clip(1e-300)
    return distance

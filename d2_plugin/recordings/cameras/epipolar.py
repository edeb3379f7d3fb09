"""Features of images, and where the calibration of two cameras lets one see what the other sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from d2_plugin.recordings.cameras.camera import rigid
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.images import checked_image, opencv
from d2_plugin.recordings.recording import Camera

SCALES = (16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 0.5, 0.5)  # pixels beyond which a match hardly counts, round by round
LARGEST_TURN = 0.05  # radians of one step

Sift = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Features: pixels [n, 2] with centres at i + 0.5, descriptors [n, 128], (size in pixels, angle in radians) [n, 2]."""


def sift_features(
    image: np.ndarray,
    most: int,
    purpose: str,
    contrast: float,
    mask: np.ndarray | None = None,
    tilted: bool = False,
) -> Sift:
    """The features of an image.

    Args:
        image: RGB uint8 [H, W, 3].
        most: features, those of the highest contrast.
        purpose: what needs OpenCV, in the sentence that says where it is missing.
        contrast: of a feature, at least; .04 in OpenCV.
        mask: bool [H, W], where features may lie.
        tilted: in the image as nine cameras would see it from aside (Morel and Yu 2009: ASIFT), `most` in each.
    """
    cv2 = opencv(purpose, "calibration")
    grey = cv2.cvtColor(checked_image(image, "the image of a camera"), cv2.COLOR_RGB2GRAY)
    # Without `enable_precise_upscale` OpenCV's SIFT is a quarter of a pixel too far right and down.
    sift = cv2.SIFT_create(most, contrastThreshold=contrast, enable_precise_upscale=True)
    sift = cv2.AffineFeature_create(sift, 2, 1) if tilted else sift
    points, descriptors = sift.detectAndCompute(grey, None if mask is None else mask.astype(np.uint8))
    pixels = np.array([point.pt for point in points]).reshape(-1, 2) + 0.5
    shapes = np.array([(point.size, np.deg2rad(point.angle)) for point in points]).reshape(-1, 2)
    return pixels, np.zeros((0, 128), np.float32) if descriptors is None else descriptors, shapes


def fundamental(one: Camera, other: Camera) -> np.ndarray:
    """F [3, 3] with q^T F p = 0 for pixels p of `one` and q of `other`."""
    relative = other.T_camera_world @ np.linalg.inv(one.T_camera_world)
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.linalg.inv(other.K).T @ cross @ relative[:3, :3] @ np.linalg.inv(one.K))


def sampson(one: Camera, other: Camera, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distance [n] in pixels, to first order and signed, of pairs [n, 2] from the nearest that two cameras allow."""
    F, ones = fundamental(one, other), np.ones((len(p), 1))
    there, back = np.hstack([p, ones]) @ F.T, np.hstack([q, ones]) @ F
    squares = (there[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.asarray((np.hstack([q, ones]) * there).sum(axis=1) / np.sqrt(squares).clip(1e-300))


Matched = Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]  # two cameras -> pixels [m, 2] of the same things


def turned(name: str, cameras: Mapping[str, Camera], matched: Matched) -> Camera:
    """One camera, turned where it stands so that its matches with the others miss the epipolar lines the least.

    Positions of a calibration are rarely wrong, and with them held three angles are settled by few features.
    Gauss-Newton with Cauchy's loss, whose scale falls to `SCALES[-1]` pixels.
    """
    own = {pair: pixels for pair, pixels in matched.items() if name in pair}
    camera, step = cameras[name], 1e-5
    if not own:
        return camera

    def misses(angles: np.ndarray) -> np.ndarray:
        trial = {**cameras, name: rotated(camera, angles)}
        return np.concatenate([sampson(trial[a], trial[b], p, q) for (a, b), (p, q) in own.items()])

    for scale in SCALES:
        here = misses(np.zeros(3))
        slopes = np.stack([(misses(step * axis) - here) / step for axis in np.eye(3)], axis=1)
        weighted = slopes / (1 + (here / scale) ** 2)[:, None]
        angles = -np.linalg.lstsq(weighted.T @ slopes, weighted.T @ here, rcond=1e-9)[0]
        camera = rotated(camera, np.clip(angles, -LARGEST_TURN, LARGEST_TURN))
    return camera


def rotated(camera: Camera, angles: np.ndarray) -> Camera:
    """The camera turned where it stands, about its own axes, by angles [3] in radians."""
    turn = rigid(rotation_of_vector(angles), np.zeros(3))
    return replace(camera, T_camera_world=turn @ camera.T_camera_world)


def degrees_between(one: Camera, other: Camera) -> float:
    """Degrees between two orientations."""
    turn = one.T_camera_world[:3, :3] @ other.T_camera_world[:3, :3].T
    sine = np.linalg.norm(turn - turn.T) / (2 * np.sqrt(2))  # accurate at small angles, as a cosine is not
    return float(np.rad2deg(np.arctan2(sine, (np.trace(turn) - 1) / 2)))

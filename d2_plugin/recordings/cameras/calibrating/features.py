"""Features of images and what two cameras saw of the same thing at the same moment.

A camera that stands still is one camera however many images it took: the features of all its moments are one list.
Only features of the same moment are matched, so whatever moves is as good a witness as a wall. The cameras' images
are undistorted, and pixel i has its centre at i + 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from types import ModuleType

import numpy as np

from d2_plugin.extras import import_pycolmap
from d2_plugin.recordings.images import checked_image, opencv
from d2_plugin.recordings.recording import Camera

MOST_FEATURES = 4000
"""Per image."""

LEAST_CONTRAST = 0.005
"""OpenCV's is .04: faint features are many, and false matches are found out by geometry. Studio 01 02 03 04, 320x180:
poses within .14 degrees at .015 and 1500 features an image, within .09 at .005 and 4000."""

RATIO = 0.85
"""The best match is nearer than the second best by this factor, on square roots of SIFT."""

CHANGE = 10.0
"""Levels of 255 by which an image differs from what usually is there where something moves."""

ENOUGH_MATCHES = 15
"""Verified matches below which two cameras say nothing about each other."""

PIXEL_ERROR = 1.5
"""Largest distance of a match from its epipolar line, in pixels of images of up to `LONG_SIDE`."""

LONG_SIDE = 960.0

Pair = tuple[str, str]
Matches = dict[Pair, np.ndarray]
"""Two cameras -> indices [m, 2] into their lists of features."""


@dataclass(frozen=True, eq=False)
class Features:
    """What one camera saw at all moments."""

    pixels: np.ndarray  # [n, 2] float64
    descriptors: np.ndarray  # [n, 128] float32
    moments: np.ndarray  # [n] which image
    shapes: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # [n, 2] size in pixels, angle in radians
    greys: tuple[np.ndarray, ...] | None = None
    """The images uint8 [H, W] by moment, where features may be moved to better places."""


def silent_pycolmap(purpose: str) -> ModuleType:
    """The module pycolmap, silent; `purpose` completes the sentence "<purpose> needs pycolmap"."""
    pycolmap = import_pycolmap(purpose, "calibration")
    pycolmap.logging.minloglevel = 2
    return pycolmap


def find_features(images: Sequence[np.ndarray], recorded: np.ndarray | None = None) -> Features:
    """Features of one camera's images RGB uint8 [H, W, 3], none where `recorded` [H, W] says that nothing was."""
    return _found(images, [recorded] * len(images))


def of_a_still_camera(images: Sequence[np.ndarray], recorded: np.ndarray | None = None) -> Features:
    """Features of what stands still, once and as moment 0, then of what moves in each of the images.

    A wall that is seen at ten moments is one witness, not ten.
    """
    if len(images) < 3:
        return find_features([images[0], *images], recorded)
    still = np.median(np.stack(images), axis=0).astype(np.uint8)
    masks = [_moving(image, still) & (True if recorded is None else recorded) for image in images]
    return _found([still, *images], [recorded, *masks])


def _moving(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Where and around where the image is another one than the still, bool [H, W]."""
    cv2 = opencv("calibrating from images", "calibration")
    change = np.abs(image.astype(np.int16) - still).max(axis=-1).astype(np.float32)
    moving = (cv2.GaussianBlur(change, (0, 0), 1.0) > CHANGE).astype(np.uint8)
    return np.asarray(cv2.dilate(moving, np.ones((9, 9)))) > 0


def _found(images: Sequence[np.ndarray], masks: Sequence[np.ndarray | None]) -> Features:
    cv2 = opencv("calibrating from images", "calibration")
    # Without `enable_precise_upscale` OpenCV's SIFT is a quarter of a pixel too far right and down.
    sift = cv2.SIFT_create(MOST_FEATURES, contrastThreshold=LEAST_CONTRAST, enable_precise_upscale=True)
    pixels, descriptors, shapes = [np.zeros((0, 2))], [np.zeros((0, 128), np.float32)], [np.zeros((0, 2))]
    moments, greys = [np.zeros(0, int)], []
    for moment, (image, mask) in enumerate(zip(images, masks, strict=True)):
        greys.append(cv2.cvtColor(checked_image(image, f"image {moment} of a camera"), cv2.COLOR_RGB2GRAY))
        points, found = sift.detectAndCompute(greys[-1], None if mask is None else mask.astype(np.uint8))
        if found is None:
            continue
        pixels.append(np.array([point.pt for point in points]) + 0.5)
        descriptors.append(np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-12)))
        shapes.append(np.array([(point.size, np.deg2rad(point.angle)) for point in points]))
        moments.append(np.full(len(points), moment))
    places, kinds = (np.concatenate(pixels), np.concatenate(descriptors)), np.concatenate(shapes)
    return Features(*places, np.concatenate(moments), kinds, tuple(greys))


def match_all(features: Mapping[str, Features]) -> Matches:
    """Mutually best matches of every two cameras, moment by moment; nothing is verified yet."""
    return {(a, b): _match(features[a], features[b]) for a, b in combinations(features, 2)}


def _match(one: Features, other: Features) -> np.ndarray:
    found = [np.zeros((0, 2), int)]
    for moment in np.intersect1d(one.moments, other.moments):
        rows, columns = np.flatnonzero(one.moments == moment), np.flatnonzero(other.moments == moment)
        if min(len(rows), len(columns)) < 2:
            continue
        # Unit vectors: the squared distance is 2 - 2 times the product.
        products = one.descriptors[rows] @ other.descriptors[columns].T
        best = products.argmax(axis=1)
        two = -np.partition(-products, 1, axis=1)[:, :2]
        near, second = (np.sqrt(np.maximum(2 - 2 * two[:, place], 0)) for place in (0, 1))
        mutual = products.argmax(axis=0)[best] == np.arange(len(rows))
        good = mutual & (near < RATIO * second)
        found.append(np.stack([rows[good], columns[best[good]]], axis=1))
    return _distinct(np.concatenate(found), one, other)


def _distinct(matches: np.ndarray, one: Features, other: Features) -> np.ndarray:
    """Each pair of places once: SIFT puts several features with different orientations at one place."""
    places = np.hstack([one.pixels[matches[:, 0]], one.moments[matches[:, :1]], other.pixels[matches[:, 1]]])
    return matches[np.unique(places, axis=0, return_index=True)[1]]


def pixel_error(camera: Camera) -> float:
    """`PIXEL_ERROR` in pixels of this camera."""
    return PIXEL_ERROR * max(max(camera.width, camera.height) / LONG_SIDE, 0.5)


def fundamental(one: Camera, other: Camera) -> np.ndarray:
    """F [3, 3] with q^T F p = 0 for pixels p of `one` and q of `other`."""
    relative = other.T_camera_world @ np.linalg.inv(one.T_camera_world)
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    product: np.ndarray = np.linalg.inv(other.K).T @ cross @ relative[:3, :3] @ np.linalg.inv(one.K)
    return product


def sampson(one: Camera, other: Camera, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distance [n] in pixels, to first order, of pairs [n, 2] from the nearest that `one` and `other` allow."""
    F, ends = fundamental(one, other), np.ones((len(p), 1))
    ph, qh = np.hstack([p, ends]), np.hstack([q, ends])
    there, back = ph @ F.T, qh @ F
    squares = (there[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    distance: np.ndarray = np.abs((qh * there).sum(axis=1)) / np.sqrt(squares).clip(1e-300)
    return distance

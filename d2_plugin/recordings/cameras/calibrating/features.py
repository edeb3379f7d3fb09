"""Features of images, what two cameras saw of the same thing at the same moment, and which of it one motion explains.

A camera that stands still is one camera however many images it took: the features of all its moments are one list.
Only features of the same moment are matched, so whatever moves is as good a witness as a wall. The cameras' images
are undistorted, and pixel i has its centre at i + 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np

from d2_plugin.extras import import_pycolmap
from d2_plugin.recordings.cameras.camera import rigid
from d2_plugin.recordings.cameras.epipolar import sampson, sift_features
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

MOST_FEATURES = 4000  # per image
MOST_TILTED = 800  # the same in each image as seen from aside
LEAST_CONTRAST = 0.005  # an eighth of OpenCV's: faint features are many, and geometry sorts out false matches
RATIO = 0.85  # the best match is nearer than the second best by this factor, on square roots of SIFT
CHANGE = 10.0  # levels of 255 by which an image differs from what usually is there where something moves
ENOUGH_MATCHES = 15  # verified matches below which two cameras say nothing about each other
PIXEL_ERROR = 1.5  # largest distance of a match from its epipolar line, in pixels of images of up to `LONG_SIDE`

LONG_SIDE = 960.0

LEAST_INLIERS = 0.05  # share of inliers that RANSAC looks for, at least
MOST_TRIALS, FEW_TRIALS = 100_000, 20_000  # of RANSAC; few where known poses have dropped matches before

Pair = tuple[str, str]
Matches = dict[Pair, np.ndarray]  # two cameras -> indices [m, 2] into their lists of features


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


def of_a_still_camera(
    images: Sequence[np.ndarray], recorded: np.ndarray | None = None, tilted: bool = False
) -> Features:
    """Features of what stands still, once and as moment 0, then of what moves in each of the images.

    A wall that is seen at ten moments is one witness, not ten. `tilted` as `find_features` has it.
    """
    if len(images) < 3:
        return find_features([images[0], *images], [recorded] * (len(images) + 1), tilted)
    still = np.median(np.stack(images), axis=0).astype(np.uint8)
    masks = [_moving(image, still) & (True if recorded is None else recorded) for image in images]
    return find_features([still, *images], [recorded, *masks], tilted)


def _moving(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Where and around where the image is another one than the still, bool [H, W]."""
    cv2 = opencv("calibrating from images", "calibration")
    change = np.abs(image.astype(np.int16) - still).max(axis=-1).astype(np.float32)
    moving = (cv2.GaussianBlur(change, (0, 0), 1.0) > CHANGE).astype(np.uint8)
    return np.asarray(cv2.dilate(moving, np.ones((9, 9)))) > 0


def find_features(
    images: Sequence[np.ndarray], masks: Sequence[np.ndarray | None] | None = None, tilted: bool = False
) -> Features:
    """Features of one camera's images RGB uint8 [H, W, 3], only where masks bool [H, W] are true.

    `tilted` adds those of the first image as seen from aside: cameras 40 degrees apart share hardly any others.
    """
    cv2 = opencv("calibrating from images", "calibration")
    masks = masks or [None] * len(images)
    parts = [
        sift_features(image, MOST_FEATURES, "calibrating from images", LEAST_CONTRAST, mask)
        for image, mask in zip(images, masks, strict=True)
    ]
    moments = np.repeat(np.arange(len(images)), [len(part[0]) for part in parts])
    if tilted:
        more = sift_features(images[0], MOST_TILTED, "calibrating from images", LEAST_CONTRAST, masks[0], tilted=True)
        parts, moments = [*parts, more], np.concatenate([moments, np.zeros(len(more[0]), int)])
    pixels, descriptors, shapes = (np.concatenate(part) for part in zip(*parts))
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    return Features(pixels, roots, moments, shapes, tuple(cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in images))


def match_all(features: Mapping[str, Features]) -> Matches:
    """Mutually best matches of every two cameras, moment by moment; nothing is verified yet."""
    return {(a, b): _match(features[a], features[b]) for a, b in combinations(features, 2)}


def _match(one: Features, other: Features) -> np.ndarray:
    matches = [np.zeros((0, 2), int)]
    for moment in np.intersect1d(one.moments, other.moments):
        rows, columns = np.flatnonzero(one.moments == moment), np.flatnonzero(other.moments == moment)
        if min(len(rows), len(columns)) < 2:
            continue
        # Unit vectors: the squared distance is 2 - 2 times the product.
        products = one.descriptors[rows] @ other.descriptors[columns].T
        best = np.arange(len(rows)), products.argmax(axis=1)
        first, mutual = products[best], products[best] == products.max(axis=0)[best[1]]
        products[best] = -1
        near, second = (np.sqrt(np.maximum(2 - 2 * product, 0)) for product in (first, products.max(axis=1)))
        good = mutual & (near < RATIO * second)
        matches.append(np.stack([rows[good], columns[best[1][good]]], axis=1))
    found = np.concatenate(matches)
    # Each pair of places once: SIFT puts several features with different orientations at one place.
    places = np.hstack([one.pixels[found[:, 0]], one.moments[found[:, :1]], other.pixels[found[:, 1]]])
    return found[np.unique(places, axis=0, return_index=True)[1]]


def pixel_error(camera: Camera) -> float:
    """`PIXEL_ERROR` in pixels of this camera."""
    return PIXEL_ERROR * max(max(camera.width, camera.height) / LONG_SIDE, 0.5)


def verified(
    matches: Matches, features: Mapping[str, Features], cameras: Mapping[str, Camera], near: float | None = None
) -> Matches:
    """The matches that an essential matrix explains; pairs of cameras with too few are left out.

    `near`, in pixels, first drops matches farther than that from where the poses of `cameras` expect them.
    """
    explained: Matches = {}
    for (a, b), pairs in matches.items():
        if near is not None:
            p, q = features[a].pixels[pairs[:, 0]], features[b].pixels[pairs[:, 1]]
            pairs = pairs[np.abs(sampson(cameras[a], cameras[b], p, q)) < near]
        result = _ransac((a, b), pairs, features, cameras, MOST_TRIALS if near is None else FEW_TRIALS)
        inside = np.zeros(len(pairs), bool) if result is None else np.asarray(result["inlier_mask"], bool)
        if inside.sum() >= ENOUGH_MATCHES:
            explained[a, b] = pairs[inside]
    return explained


def essential_pose(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera]
) -> np.ndarray | None:
    """T [4, 4] from the first camera to the second, which stands a unit away; None where the pairs say nothing."""
    result = _ransac(pair, pairs, features, cameras, MOST_TRIALS)
    if result is None:
        return None
    cv2 = opencv("finding cameras", "calibration")
    rays = []
    for name, column in zip(pair, (0, 1), strict=True):
        K, pixels = cameras[name].K, features[name].pixels[pairs[:, column]]
        rays.append((pixels - K[:2, 2]) / K[[0, 1], [0, 1]])
    _, rotation, translation, _ = cv2.recoverPose(np.asarray(result["E"]), rays[0], rays[1], np.eye(3))
    return rigid(rotation, translation[:, 0])


def _ransac(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera], most: int
) -> dict[str, Any] | None:
    if len(pairs) < ENOUGH_MATCHES:
        return None
    pycolmap = silent_pycolmap("verifying matches")
    one, other = (cameras[name] for name in pair)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed, options.min_inlier_ratio = pixel_error(one), 0, LEAST_INLIERS
    options.max_num_trials = most
    p, q = features[pair[0]].pixels[pairs[:, 0]], features[pair[1]].pixels[pairs[:, 1]]
    result: dict[str, Any] | None = pycolmap.estimate_essential_matrix(p, q, as_colmap(one), as_colmap(other), options)
    return result


def as_colmap(camera: Camera, number: int = 1, one_focal: bool = False) -> Any:
    """A camera as pycolmap has it, with `one_focal` length or two; both have the first pixel's centre at 0.5."""
    (fx, fy), (cx, cy) = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    model, values = ("SIMPLE_PINHOLE", [fx, cx, cy]) if one_focal else ("PINHOLE", [fx, fy, cx, cy])
    size = {"width": camera.width, "height": camera.height}
    return import_pycolmap("calibrating", "calibration").Camera(camera_id=number, model=model, params=values, **size)

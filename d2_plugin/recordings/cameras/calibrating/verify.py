"""Matches that one motion of a rigid scene explains: an essential matrix found by RANSAC (pycolmap), pair by pair."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from d2_plugin.recordings.cameras.calibrating.features import (
    ENOUGH_MATCHES,
    Features,
    Matches,
    Pair,
    pixel_error,
    sampson,
    silent_pycolmap,
)
from d2_plugin.recordings.cameras.calibration import rigid
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

LEAST_INLIERS = 0.05
"""Share of inliers that RANSAC looks for, at least."""


def verified(
    matches: Matches, features: Mapping[str, Features], cameras: Mapping[str, Camera], near: float | None = None
) -> Matches:
    """The matches that an essential matrix explains; pairs of cameras with too few are left out.

    `near`, in pixels, first drops matches farther than that from where the poses of `cameras` expect them.
    """
    found: Matches = {}
    for pair, pairs in matches.items():
        kept = pairs if near is None else pairs[_distances(pair, pairs, features, cameras) < near]
        inside = essential(pair, kept, features, cameras)
        if inside is not None and len(kept[inside]) >= ENOUGH_MATCHES:
            found[pair] = kept[inside]
    return found


def essential(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera]
) -> np.ndarray | None:
    """Which [m] of the pairs one essential matrix explains, None where there is none; the same each time."""
    result = _ransac(pair, pairs, features, cameras)
    return None if result is None else np.asarray(result["inlier_mask"], bool)


def essential_pose(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera]
) -> np.ndarray | None:
    """T [4, 4] from the first camera to the second, which stands a unit away; None where the pairs say nothing."""
    result = _ransac(pair, pairs, features, cameras)
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
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera]
) -> dict[str, Any] | None:
    if len(pairs) < ENOUGH_MATCHES:
        return None
    pycolmap = silent_pycolmap("verifying matches")
    one, other = (cameras[name] for name in pair)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed, options.min_inlier_ratio = pixel_error(one), 0, LEAST_INLIERS
    p, q = features[pair[0]].pixels[pairs[:, 0]], features[pair[1]].pixels[pairs[:, 1]]
    found: dict[str, Any] | None = pycolmap.estimate_essential_matrix(p, q, as_colmap(one), as_colmap(other), options)
    return found


def as_colmap(camera: Camera) -> Any:
    """A pinhole camera as pycolmap has it; both put the centre of the first pixel at 0.5."""
    K = camera.K
    return silent_pycolmap("calibrating").Camera(
        camera_id=1,
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )


def _distances(
    pair: Pair, pairs: np.ndarray, features: Mapping[str, Features], cameras: Mapping[str, Camera]
) -> np.ndarray:
    p, q = features[pair[0]].pixels[pairs[:, 0]], features[pair[1]].pixels[pairs[:, 1]]
    return sampson(cameras[pair[0]], cameras[pair[1]], p, q)

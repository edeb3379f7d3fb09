"""Matches that one motion of a rigid scene explains: an essential matrix found by RANSAC (pycolmap), pair by pair."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from d2_plugin.captures.calibrate.features import (
    ENOUGH_MATCHES,
    Features,
    Matches,
    Pair,
    pixel_error,
    pycolmap_module,
    sampson,
)
from d2_plugin.captures.capture import Camera

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
    if len(pairs) < ENOUGH_MATCHES:
        return None
    pycolmap = pycolmap_module("verifying matches")
    one, other = (cameras[name] for name in pair)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed, options.min_inlier_ratio = pixel_error(one), 0, LEAST_INLIERS
    p, q = features[pair[0]].pixels[pairs[:, 0]], features[pair[1]].pixels[pairs[:, 1]]
    result = pycolmap.estimate_essential_matrix(p, q, as_colmap(one), as_colmap(other), options)
    return None if result is None else np.asarray(result["inlier_mask"], bool)


def as_colmap(camera: Camera) -> Any:
    """A pinhole camera as pycolmap has it; both put the centre of the first pixel at 0.5."""
    K = camera.K
    return pycolmap_module("calibrating").Camera(
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

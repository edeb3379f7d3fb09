"""OpenCV's semi-global matching, which geometric depth is compared with. It is never used for priors.

It knows rectified pairs only, so every view is rectified with the source that PatchMatch would match first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.extras import opencv
from d2_plugin.priors.geometry import index_intrinsics, relative_pose, viewing_rays
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.pyramid import NO_MATCH
from d2_plugin.priors.stereo.source_views import choose_sources
from d2_plugin.recordings.recording import Camera

BLOCK = 5  # side of the matched block, pixels; smoothness as OpenCV's documentation advises for one channel
SUBPIXEL = 16  # OpenCV's disparities are fixed point


class Rectified(NamedTuple):
    """A pair turned so that corresponding pixels share a row."""

    rotation: np.ndarray  # [3, 3], reference camera to rectified camera
    K: np.ndarray  # [3, 3] of the rectified reference, array indices
    baseline: float  # focal length times distance, signed: disparity = -baseline / z + offset
    offset: float  # difference of the principal points, pixels
    left: np.ndarray
    right: np.ndarray


def sgbm(
    grays: Sequence[np.ndarray], cameras: Sequence[Camera], depth_range: tuple[float, float], settings: StereoSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and cost (0 where there is a depth) of every view, as matchers of this package return them.

    Raises:
        D2Error: a pair is not beside each other, or its disparities span more than the image.
    """
    results = []
    for index, (gray, camera) in enumerate(zip(grays, cameras)):
        others = choose_sources(index, cameras, depth_range, settings)
        if not others:
            results.append((np.zeros(gray.shape, np.float32), np.full(gray.shape, NO_MATCH, np.float32)))
            continue
        depth = _pair_depth(gray, grays[others[0]], camera, cameras[others[0]], depth_range)
        results.append((depth, np.where(depth > 0, 0, NO_MATCH).astype(np.float32)))
    return results


def _pair_depth(
    gray: np.ndarray, other: np.ndarray, camera: Camera, source: Camera, depth_range: tuple[float, float]
) -> np.ndarray:
    cv2 = opencv("semi-global matching")
    pair = _rectify(cv2, gray, other, camera, source)
    bounds = [-pair.baseline / depth + pair.offset for depth in depth_range]
    lowest = int(np.floor(min(bounds)))
    count = int(np.ceil((max(bounds) - lowest + 1) / SUBPIXEL)) * SUBPIXEL
    if count >= gray.shape[1]:
        raise D2Error(f"disparities of {camera.name} span {count} pixels and the image has {gray.shape[1]}")
    matcher = cv2.StereoSGBM_create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=BLOCK,
        P1=8 * BLOCK**2,
        P2=32 * BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    fixed = matcher.compute(pair.left, pair.right)
    disparity = fixed.astype(np.float32) / SUBPIXEL - pair.offset
    with np.errstate(divide="ignore"):
        depth = np.where(fixed >= lowest * SUBPIXEL, -pair.baseline / disparity, 0)
    return _unrectified(cv2, np.where(np.isfinite(depth) & (depth > 0), depth, 0), pair, camera)


def _rectify(cv2: Any, gray: np.ndarray, other: np.ndarray, camera: Camera, source: Camera) -> Rectified:
    T = relative_pose(camera, source)
    size, none = (camera.width, camera.height), np.zeros(5)
    K, K_source = index_intrinsics(camera), index_intrinsics(source)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3:])
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K, none, K_source, none, size, R, t, flags=0, alpha=-1)
    if abs(P2[1, 3]) > abs(P2[0, 3]):
        raise D2Error(
            f"cameras {camera.name} and {source.name} stand above each other, which semi-global matching cannot match"
        )
    maps = [
        cv2.initUndistortRectifyMap(intrinsics, none, rotation, projection[:, :3], size, cv2.CV_32FC1)
        for intrinsics, rotation, projection in ((K, R1, P1), (K_source, R2, P2))
    ]
    left, right = (cv2.remap(image, *lookup, cv2.INTER_LINEAR) for image, lookup in zip((gray, other), maps))
    return Rectified(R1, P1[:, :3], float(P2[0, 3]), float(P1[0, 2] - P2[0, 2]), left, right)


def _unrectified(cv2: Any, depth: np.ndarray, pair: Rectified, camera: Camera) -> np.ndarray:
    """Planar depth [H, W] of the original view from that of the rectified one, which is turned against it."""
    rays = viewing_rays(camera, np.float64) @ pair.rotation.T
    at = rays @ pair.K.T / rays[..., 2:]
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    rectified = cv2.remap(depth.astype(np.float32), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return (rectified / rays[..., 2]).astype(np.float32)

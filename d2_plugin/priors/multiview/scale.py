"""The scale of a multi-view network's depth in the world of the calibration.

Two things tell it without any match: the similarity that brings the network's cameras to the calibrated ones, and the
factor with which the views' maps show the same surfaces (`monocular.across.shared_scale`). What stands still then
holds all instants to one scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from d2_plugin.priors.monocular.across import shared_scale
from d2_plugin.recordings.recording import Camera

AGREES = 0.6
"""Mean match of a map with the others' (`across.Agreement`) below which they do not show one scene."""
ANY = np.geomspace(1 / 30, 30, 61)
"""Scales that are tried, in units of the one that puts the median depth as far as the cameras span."""
CLOSE = 0.15
"""The poses' scale, which is finer, counts where it is so near, in logarithm, to the one with which maps agree best."""
MOST_POWER = 2.0
"""Of the confidence by which errors shrink."""


def pose_scale(poses: np.ndarray, cameras: Sequence[Camera]) -> float:
    """Scale of the similarity that brings predicted poses to calibrated ones; NaN where there is none.

    Rotations alone turn it, so cameras on a line, or two of them, leave nothing open; centres then give the scale by
    least squares.

    Args:
        poses: world to camera [V, 3, 4].
        cameras: the calibrated ones, in the same order.
    """
    centres = np.stack([camera.centre for camera in cameras])
    predicted = -(poses[:, :, :3].transpose(0, 2, 1) @ poses[:, :, 3:])[..., 0]
    if not np.isfinite(poses).all():
        return np.nan
    rotation = _to_our_world(poses, cameras)
    moved, target = (predicted - predicted.mean(0)) @ rotation.T, centres - centres.mean(0)
    size = float((moved * moved).sum())
    return float((moved * target).sum()) / size if size > 0 else np.nan


def turned_by(poses: np.ndarray, cameras: Sequence[Camera]) -> float:
    """By how many degrees the predicted pose that is furthest from its camera is turned, in the world of the cameras;
    arguments as of `pose_scale`, NaN where it is."""
    if not np.isfinite(poses).all():
        return np.nan
    moved = poses[:, :, :3] @ _to_our_world(poses, cameras).T
    cosines = (np.einsum("vij,vij->v", moved, [camera.T_camera_world[:3, :3] for camera in cameras]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


def _to_our_world(poses: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """The rotation from the world of predicted poses to that of the cameras."""
    ours = np.stack([camera.T_camera_world[:3, :3] for camera in cameras])
    left, _, right = np.linalg.svd((ours.transpose(0, 2, 1) @ poses[:, :, :3]).sum(0))
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def world_scale(maps: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], poses: np.ndarray | None) -> float:
    """The scale of depth maps [H, W] in the world; NaN where neither poses nor maps tell it.

    Args:
        maps: the network's depth by camera, NaN where it has none or is not sure.
        cameras: the calibrated ones, in the order of `poses` [V, 3, 4].
        poses: the network's; None where it gave none.
    """
    span = float(np.linalg.norm(np.ptp(np.stack([camera.centre for camera in cameras.values()]), axis=0)))
    depth = np.concatenate([map_[np.isfinite(map_)] for map_ in maps.values()])
    if not (span > 0 and depth.size):
        return np.nan
    shared = shared_scale(maps, cameras, span / float(np.median(depth)) * ANY)
    given = np.nan if poses is None else pose_scale(poses, list(cameras.values()))
    matched = [fit.matched for fit in shared.agreements.values()]
    if given > 0 and (min(matched, default=0.0) < AGREES or abs(np.log(given / shared.scale)) < CLOSE):
        return given
    return shared.scale if any(matched) else np.nan


def log_ratio(now: np.ndarray, before: np.ndarray) -> float:
    """Median log of two instants' maps [V, h, w], which is that of what stands still; 0 where they share nothing."""
    both = np.isfinite(now) & np.isfinite(before)
    return float(np.median(np.log(now[both] / before[both]))) if both.any() else 0.0


def power_of(confidence: np.ndarray, error: np.ndarray) -> float:
    """p with which errors [n] shrink as confidence^-p [n], 0 where they do not: so no two networks' units are compared.

    From the medians of the surest and of the least sure quarter.
    """
    low, high = np.quantile(confidence, (0.25, 0.75)) if confidence.size else (0.0, 0.0)
    if not 0 < low < high:
        return 0.0
    worst, best = (confidence <= low), (confidence >= high)
    reach = np.log(np.median(confidence[best]) / np.median(confidence[worst]))
    tiny = np.finfo(float).tiny
    gain = np.log(max(np.median(error[worst]), tiny) / max(np.median(error[best]), tiny))
    return float(np.clip(gain / reach, 0, MOST_POWER))

"""The scale of a multi-view network's depth in the world of the calibration.

Two things tell it without any match: the similarity that brings the network's cameras to the calibrated ones, and the
factor with which the views' maps show the same surfaces (`monocular.across.shared_scale`). What stands still then
holds all instants to one scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.monocular.across import Shared, shared_scale
from d2_plugin.recordings.recording import Camera

AGREES = 0.6
"""Mean match of a map with the others' (`across.Agreement`) below which they do not show one scene."""
AROUND = np.geomspace(0.8, 1.25, 9)
"""Scales that are tried, in units of the one that poses give."""
ANY = np.geomspace(1 / 30, 30, 61)
"""Without poses: in units of the one that puts the median depth as far as the cameras span."""
TURNED, MOVED = 15.0, 0.3
"""Degrees, and share of the cameras' span, by which the network's cameras may miss: beyond, its poses say nothing."""
MOST_POWER = 2.0
"""Of the confidence by which errors shrink."""


class Similarity(NamedTuple):
    """From the network's world to the calibration's: X = scale * rotation @ x + shift."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    turned: float
    """Largest angle by which a camera looks elsewhere than calibrated, degrees."""
    moved: float
    """How far camera centres are off: root mean square over that of their distance to their mean."""


def similarity(poses: np.ndarray, cameras: Sequence[Camera]) -> Similarity | None:
    """The similarity that brings predicted poses to calibrated ones; None where all cameras stand at one point.

    Rotations alone turn it, so cameras on a line, or two of them, leave nothing open; centres then give scale and shift
    by least squares.

    Args:
        poses: world to camera [V, 3, 4].
        cameras: the calibrated ones, in the same order.
    """
    ours = np.stack([camera.T_camera_world[:3, :3] for camera in cameras])
    centres = np.stack([camera.centre for camera in cameras])
    theirs = poses[:, :, :3]
    predicted = -(theirs.transpose(0, 2, 1) @ poses[:, :, 3:])[..., 0]
    if not (np.isfinite(poses).all() and np.ptp(predicted, axis=0).max() > 0 and np.ptp(centres, axis=0).max() > 0):
        return None
    left, _, right = np.linalg.svd((ours.transpose(0, 2, 1) @ theirs).sum(0))
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    moved, target = (predicted - predicted.mean(0)) @ rotation.T, centres - centres.mean(0)
    scale = float((moved * target).sum() / (moved * moved).sum())
    off = np.linalg.norm(scale * moved - target) / np.linalg.norm(target)
    cosine = (np.einsum("vij,vij->v", ours @ rotation, theirs) - 1) / 2
    turned = float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max())
    return Similarity(scale, rotation, centres.mean(0) - scale * rotation @ predicted.mean(0), turned, float(off))


def world_scale(maps: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], poses: np.ndarray | None) -> Shared:
    """The scale of depth maps [H, W] in the world: about what the poses give where the maps then agree, else any.

    Args:
        maps: the network's depth by camera, NaN where it has none or is not sure.
        cameras: the calibrated ones, in the order of `poses` [V, 3, 4].
        poses: the network's; None where it gave none.
    """
    found = None if poses is None else similarity(poses, list(cameras.values()))
    if found is not None and found.scale > 0 and found.turned < TURNED and found.moved < MOVED:
        near = shared_scale(maps, cameras, found.scale * AROUND)
        if agree(near):
            return near
    centres = np.stack([camera.centre for camera in cameras.values()])
    span = float(np.linalg.norm(np.ptp(centres, axis=0)))
    median = float(np.nanmedian(np.concatenate([map_.ravel() for map_ in maps.values()])))
    return shared_scale(maps, cameras, span / median * ANY) if span > 0 and median > 0 else Shared(1.0, {})


def agree(shared: Shared) -> bool:
    """Whether the maps show one scene."""
    return bool(shared.agreements) and min(fit.matched for fit in shared.agreements.values()) >= AGREES


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

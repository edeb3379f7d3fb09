"""What stereo has to work with: how much of an image other cameras see, at which angle, and how much has texture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from d2_plugin.priors.geometry import projected, relative_pose, seen_by
from d2_plugin.priors.stereo.filtering.filter import texture_mask
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings import Camera, Recording
from d2_plugin.recordings.images import shrink_image

GRID = (16, 12)
"""Pixels across and down at which an image is asked who else sees it."""

KNOWN_DEPTHS = 9
"""Depths of each of those pixels where the depth of the scene is known."""

ANY_DEPTHS = 60
"""Depths of each of those pixels where it is not, over `ANY_RANGE`."""

ANY_RANGE = (0.05, 1000.0)
"""Depths tried where nothing is known about the scene, in distances between the two cameras that are farthest apart."""

ENOUGH_POINTS = 10
"""Sparse points that a camera must see to tell the depths of its image."""

TEXTURE_PIXELS = 320 * 180
"""Texture is measured in images that were made smaller until they have at most this many pixels."""


@dataclass(frozen=True)
class Overlap:
    """What the cameras of a rig see of each other's images."""

    shares: tuple[float, ...]
    """Of each camera's image, the part that some other camera sees at an angle that can be matched, 0..1."""
    angles: tuple[float, ...]
    """Of each camera that shares anything, the angle to the one it shares most with, degrees."""
    depth_known: bool
    """Whether the depth of the scene is known. Where not, `shares` holds what could be seen if every pixel lay at the
    best possible depth, and `angles` are those between the optical axes."""


def measure_overlap(
    cameras: Sequence[Camera],
    settings: StereoSettings,
    *,
    depth_range: tuple[float, float] | None = None,
    points: np.ndarray | None = None,
) -> Overlap:
    """Who sees what of whose image; occlusion is not known and left out of account.

    Args:
        cameras: the cameras that would be matched, at least two that stand apart.
        settings: `min_angle` and `max_angle` bound the angles, in degrees, at which two cameras can be matched.
        depth_range: near and far of the scene, world units; without it what the cameras declare, if any do.
        points: surface points [P, 3], world; they tell the depths better than any range.
    """
    depths = [_depths(camera, cameras, depth_range, points) for camera in cameras]
    known = all(values is not None for values in depths)
    centres = np.stack([camera.centre for camera in cameras])
    anywhere = np.linalg.norm(centres[:, None] - centres, axis=-1).max() * np.geomspace(*ANY_RANGE, ANY_DEPTHS)
    shares, angles = [], []
    for index, (camera, values) in enumerate(zip(cameras, depths, strict=True)):
        others = [other for place, other in enumerate(cameras) if place != index]
        looks = [seen_by(camera, other, GRID, anywhere if values is None else values) for other in others]
        shared = [(it & (settings.min_angle < angle) & (angle < settings.max_angle), angle) for it, angle in looks]
        # [D, pixels] of each other camera; where no depth is known, whether there is one at which it sees the pixel.
        seen = [alike if known else np.any(alike, axis=0, keepdims=True) for alike, _ in shared]
        shares.append(float(np.mean(np.any(np.stack(seen), axis=0))))
        if shares[-1] > 0:
            best = int(np.argmax([alike.mean() for alike in seen]))
            alike, angle = shared[best]
            between_axes = np.arccos(np.clip(relative_pose(camera, others[best])[2, 2], -1, 1))
            angles.append(float(np.median(angle[alike]) if known else np.rad2deg(between_axes)))
    return Overlap(tuple(shares), tuple(angles), known)


def measure_texture(recording: Recording, cameras: Sequence[str]) -> tuple[float, ...]:
    """Share of each camera's images with enough texture to match, by the test of the stereo filter, 0..1.

    The first and the last frame are looked at, made smaller: a window then covers more of the scene, so the share is
    rather too high than too low.
    """
    shares = []
    for name in cameras:
        parts = []
        for frame in sorted({recording.frames[0], recording.frames[-1]}):
            image = recording.image(name, frame)
            factor = math.ceil(math.sqrt(image.shape[0] * image.shape[1] / TEXTURE_PIXELS))
            parts.append(texture_mask(gray(shrink_image(image, factor) if factor > 1 else image)).mean())
        shares.append(float(np.mean(parts)))
    return tuple(shares)


def _depths(
    camera: Camera, cameras: Sequence[Camera], depth_range: tuple[float, float] | None, points: np.ndarray | None
) -> np.ndarray | None:
    """Depths [D] at which the things in a camera's image lie, or None if they are unknown."""
    if depth_range is None and points is not None:
        _, depths, seen = projected(camera, points)
        if np.count_nonzero(seen) >= ENOUGH_POINTS:
            return np.quantile(depths[seen], np.linspace(0.05, 0.95, KNOWN_DEPTHS))
    declared = [other.near_far for other in (camera, *cameras) if other.near_far is not None]
    if depth_range is None and not declared:
        return None
    near, far = depth_range or declared[0]
    return 1 / np.linspace(1 / near, 1 / far, KNOWN_DEPTHS)

"""The depth range that a rig is searched in: from triangulated points, from the data set, or from the cameras alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import projected, seen_by
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.cameras.camera import rig_width, same_spot
from d2_plugin.recordings.recording import Camera

FEWEST = 100
"""Points that a camera must see for their depths to bound its scene: a handful may lie on one thing, and what is nearer
or farther would never be matched."""


class DepthBounds(NamedTuple):
    """Near and far of a rig in world units, and where they come from."""

    near: float
    far: float
    origin: str


def depth_bounds(
    cameras: Sequence[Camera], points: np.ndarray | None = None, max_angle: float = StereoSettings.max_angle
) -> DepthBounds:
    """Depth range of a rig: from `FEWEST` triangulated points, else as the data set says, else from the cameras.

    Matchers take a range ten times too wide.

    Args:
        points: world points [N, 3] triangulated with the known poses, or None.
        max_angle: what two cameras see at a wider angle than this cannot be matched, degrees; it bounds the near end
            where nothing else does.

    Raises:
        D2Error: no range can be known, because all cameras stand at one point.
    """
    places = [] if points is None else [projected(camera, np.asarray(points, np.float64)) for camera in cameras]
    depths = [values[seen] for _, values, seen in places if np.count_nonzero(seen) >= FEWEST]
    if depths:
        # COLMAP's own margins around the 1st and 99th percentile of the sparse depths (model.cc, ComputeDepthRanges).
        near = min(float(np.percentile(values, 1)) for values in depths) * 0.75
        far = max(float(np.percentile(values, 99)) for values in depths) * 1.25
        return DepthBounds(near, far, f"{sum(values.size for values in depths)} triangulated observations")
    declared = [camera.near_far for camera in cameras if camera.near_far is not None]
    if declared:
        near, far = min(bounds[0] for bounds in declared), max(bounds[1] for bounds in declared)
        return DepthBounds(near * 0.8, far * 1.2, "near and far of the data set")
    return _bounds_from_baselines(cameras, max_angle)


def _bounds_from_baselines(cameras: Sequence[Camera], max_angle: float) -> DepthBounds:
    """From where two cameras begin to see something alike to half a pixel of disparity between the farthest pair."""
    pairs = [(a, b) for a in cameras for b in cameras if not same_spot(a, b)]
    if not pairs:
        names = ", ".join(camera.name for camera in cameras)
        raise D2Error(f"cameras {names} stand at one point, so nothing can be triangulated: use cameras that are apart")
    far = max(float(camera.K[0, 0]) for camera in cameras) * rig_width(cameras) / 0.5
    nearest = np.concatenate([_first_shared_depths(reference, source, far, max_angle) for reference, source in pairs])
    if nearest.size == 0:
        return DepthBounds(far / 1e4, far, "baselines alone, and no two cameras see the same")
    return DepthBounds(float(np.percentile(nearest, 2)), far, "the cameras alone, so it is very wide")


def _first_shared_depths(reference: Camera, source: Camera, far: float, max_angle: float) -> np.ndarray:
    """Depths from which on both see the same at less than `max_angle`, over a grid of pixels; empty where never."""
    depths = np.geomspace(far * 1e-6, far, 400)
    seen, angle = seen_by(reference, source, (9, 9), depths)
    alike = seen & (angle < max_angle)
    return depths[alike.argmax(axis=0)][alike.any(axis=0)]

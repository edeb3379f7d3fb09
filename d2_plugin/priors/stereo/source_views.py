"""Which other views a view is matched with: those that see the same at a good angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d2_plugin.priors.geometry import pixel_grid, scaled_camera, triangulation_angle, view_pair
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

BEST_ANGLE = 10.0
"""Angle between viewing rays, degrees, that sources are preferred for: wider ones match worse, narrower ones tell
less (MVSNet prefers 5 and tolerates up to 15)."""


def choose_sources(
    index: int, cameras: Sequence[Camera], depth_range: tuple[float, float], settings: StereoSettings
) -> list[int]:
    """Which other cameras view `index` is matched with, best first, at most `settings.patchmatch_sources`.

    Points of the view frustum are tried: a source counts for each point that it sees at an angle between `min_angle`
    and `max_angle`, the more the nearer (by ratio) that angle is to `BEST_ANGLE`. Outside of them the filter confirms
    nothing, so a camera at the same place or one that looks from the other side is never matched.
    """
    grid = scaled_camera(cameras[index], 12, 8)
    u, v = pixel_grid(grid)
    inverse = np.linspace(1 / depth_range[1], 1 / depth_range[0], 8, dtype=np.float32)
    depth = np.broadcast_to((1 / inverse)[:, None, None], (8, grid.height, grid.width))
    worth = {}
    for other, source in enumerate(cameras):
        if other == index:
            continue
        pair = view_pair(grid, source)
        at = pair.project(u, v, depth)
        seen = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < source.width) & (at.y < source.height)
        angle = np.rad2deg(triangulation_angle(grid, pair, depth))
        useful = seen & (angle > settings.min_angle) & (angle < settings.max_angle)
        ratio = np.log(np.where(useful, angle, BEST_ANGLE) / BEST_ANGLE) / np.log(3)
        worth[other] = float((useful * np.exp(-0.5 * ratio**2)).sum())
    ranked = sorted((other for other in worth if worth[other] > 0), key=lambda other: -worth[other])
    return ranked[: settings.patchmatch_sources]

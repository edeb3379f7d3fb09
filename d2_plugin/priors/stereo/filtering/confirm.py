"""How many other views confirm a geometric depth, through which parallax, and how closely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.geometry import CONTINUOUS, index_intrinsics, view_pair
from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

REPROJECTION_MAX = 1.0
"""Forward-backward reprojection error of a confirming source must be below this, pixels, as in COLMAP."""
RELATIVE_DEPTH = 0.01
"""Depths of one surface differ by less than this share: of a source and ours, and of neighbours."""
NUDGE = 1e-3
"""Change of log depth by which the parallax is measured."""


class Confirmation(NamedTuple):
    """Confirmation of each depth of a view by all sources together; maps [H, W]."""

    sources: np.ndarray
    """uint16: how many sources confirm it."""
    parallax: np.ndarray
    """Root of the sum over confirming sources of P^2, with P the pixels that the match moves per unit of log depth."""
    spread: np.ndarray
    """Root mean square relative difference to the confirming sources' own depths, weighted by P^2."""


def confirm(
    index: int,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    settings: StereoSettings,
    tolerance: float = RELATIVE_DEPTH,
) -> Confirmation:
    """Compare the depths of view `index` with those of every other view.

    A source confirms when its own depth, read where ours lands, takes us back to within `REPROJECTION_MAX` pixels
    (COLMAP's geometric consistency), agrees to `tolerance` in our view, and the two rays meet at an angle between
    `min_angle` and `max_angle`.
    """
    reference, depth = cameras[index], np.ascontiguousarray(depths[index], np.float32)
    low, high = np.deg2rad(settings.min_angle), np.deg2rad(settings.max_angle)
    numbers: dict[str, float] = {"sine_min": np.sin(low), "cosine_min": np.cos(low)}
    numbers |= {"sine_max": np.sin(high), "cosine_max": np.cos(high)}
    numbers |= {"continuous": CONTINUOUS, "reprojection_max": REPROJECTION_MAX, "relative_depth_max": tolerance}
    numbers |= {"between": settings.between_pixels, "nudge": np.exp(NUDGE), "nudge_squared": NUDGE**2}
    # Over the sources: how many confirm, sum of P^2, and of P^2 times the squared relative difference.
    confirming, information, difference = (np.zeros(depth.shape, kind) for kind in (np.uint16, float, float))
    sums = {"confirming": confirming, "information": information, "difference": difference}
    rays = np.linalg.inv(index_intrinsics(reference))
    for other, source in enumerate(cameras):
        if other == index:
            continue
        pair, back = view_pair(reference, source), view_pair(source, reference)
        theirs = np.ascontiguousarray(depths[other], np.float32)
        vectors = {"A": pair.A, "k": pair.k, "back_A": back.A, "back_k": back.k, "direction": pair.direction}
        sizes = dict(zip(("their_height", "their_width"), theirs.shape))
        maps = {"depth": depth, "theirs": theirs, **sums}
        kernel.run("confirm", maps, rays=rays, **vectors, **numbers, **sizes)
    spread = np.sqrt(difference / (information + (information == 0)))
    return Confirmation(confirming, np.sqrt(information), spread)

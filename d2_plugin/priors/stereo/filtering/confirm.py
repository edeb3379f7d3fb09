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
    sums = _Sums(np.zeros(depth.shape, np.uint16), np.zeros(depth.shape), np.zeros(depth.shape))
    for other, source in enumerate(cameras):
        if other != index:
            theirs = np.ascontiguousarray(depths[other], np.float32)
            _add_source(sums, depth, theirs, reference, source, settings, tolerance)
    spread = np.sqrt(sums.difference / (sums.information + (sums.information == 0)))
    return Confirmation(sums.confirming, np.sqrt(sums.information), spread)


class _Sums(NamedTuple):
    """Over the sources so far: how many confirm, sum of P^2, and of P^2 times the squared relative difference."""

    confirming: np.ndarray  # uint16 [H, W]
    information: np.ndarray  # float64 [H, W]
    difference: np.ndarray  # float64 [H, W]


def _add_source(
    sums: _Sums,
    depth: np.ndarray,
    theirs: np.ndarray,
    reference: Camera,
    source: Camera,
    settings: StereoSettings,
    tolerance: float,
) -> None:
    """Add the confirmation of `depth` [H, W] by one source to the sums."""
    rays = np.linalg.inv(index_intrinsics(reference))
    pair, back = view_pair(reference, source), view_pair(source, reference)
    low, high = np.deg2rad(settings.min_angle), np.deg2rad(settings.max_angle)
    vectors = {"A": pair.A, "k": pair.k, "back_A": back.A, "back_k": back.k, "direction": pair.direction, "rays": rays}
    angles = {"sine_min": np.sin(low), "cosine_min": np.cos(low), "sine_max": np.sin(high), "cosine_max": np.cos(high)}
    limits = {"continuous": CONTINUOUS, "reprojection_max": REPROJECTION_MAX, "relative_depth_max": tolerance}
    steps = {"between": settings.between_pixels, "nudge": np.exp(NUDGE), "nudge_squared": NUDGE**2}
    sizes = dict(zip(("their_height", "their_width"), theirs.shape))
    maps = {"depth": depth, "theirs": theirs, **sums._asdict()}
    kernel.run("confirm", maps, **vectors, **angles, **limits, **steps, **sizes)

"""What the other views say about a geometric depth: how many confirm it, through which parallax, and how closely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.captures.capture import Camera
from d2_plugin.priors.geometry import Projection, interpolated_surface, pixel_grid, triangulation_angle, view_pair
from d2_plugin.priors.stereo.settings import StereoSettings

NUDGE = 1e-3
"""Change of log depth by which the parallax is measured."""


class Confirmation(NamedTuple):
    """What all sources together say about each depth of a view; maps [H, W]."""

    sources: np.ndarray
    """uint8: how many sources confirm it."""
    parallax: np.ndarray
    """Root of the sum over confirming sources of P^2, with P the pixels that the match moves per unit of log depth."""
    spread: np.ndarray
    """Root mean square relative difference to the confirming sources' own depths, weighted by P^2."""


def confirm(
    index: int, cameras: Sequence[Camera], depths: Sequence[np.ndarray], settings: StereoSettings
) -> Confirmation:
    """Ask every other view about the depths of view `index`.

    A source confirms when its own depth, read where ours lands, takes us back to within
    `reprojection_max` pixels (COLMAP's geometric consistency), agrees to `relative_depth_max` in our view, and the two
    rays meet at an angle between `min_angle` and `max_angle`.
    """
    reference, depth = cameras[index], depths[index]
    u, v = pixel_grid(reference)
    count = np.zeros(depth.shape, np.uint8)
    information, difference = np.zeros(depth.shape), np.zeros(depth.shape)
    for other, source in enumerate(cameras):
        if other == index:
            continue
        pair = view_pair(reference, source)
        forth = pair.project(u, v, depth)
        seen = (sample_surface if settings.between_pixels else sample_nearest)(depths[other], forth)
        back = view_pair(source, reference).project(forth.x, forth.y, seen)
        with np.errstate(invalid="ignore", over="ignore"):
            near_pixel = np.hypot(back.x - u, back.y - v) < settings.reprojection_max
            near_depth = np.abs(back.z - depth) < settings.relative_depth_max * depth
        angle = np.rad2deg(triangulation_angle(reference, pair, depth))
        trusted = (angle > settings.min_angle) & (angle < settings.max_angle)
        confirmed = (depth > 0) & (seen > 0) & near_pixel & near_depth & trusted
        nudged = pair.project(u, v, depth * np.exp(NUDGE))
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            parallax = np.hypot(nudged.x - forth.x, nudged.y - forth.y) / NUDGE
            precision = np.where(confirmed & np.isfinite(parallax), parallax**2, 0)
            apart = np.where(confirmed, back.z / depth - 1, 0)
        count += confirmed
        information += precision
        difference += precision * apart**2
    spread = np.sqrt(difference / np.where(information > 0, information, 1))
    return Confirmation(count, np.sqrt(information), spread)


def sample_nearest(depth: np.ndarray, at: Projection) -> np.ndarray:
    """`depth` at the nearest pixel of `at`, 0 outside of the image or behind the camera.

    Nearest on purpose: a value interpolated across an occlusion edge belongs to no surface.
    """
    height, width = depth.shape
    inside = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < width - 0.5) & (at.y < height - 0.5)
    column = np.rint(np.where(inside, at.x, 0)).astype(np.int32)
    row = np.rint(np.where(inside, at.y, 0)).astype(np.int32)
    return np.where(inside, depth[row, column], 0)


def sample_surface(depth: np.ndarray, at: Projection) -> np.ndarray:
    """`depth` between the pixels around `at` where they are one surface, that of the nearest pixel elsewhere.

    On a ground that is seen at a grazing angle, depth changes by more than 1 % from one pixel to the next.
    """
    inside = at.z > 0
    known, between = interpolated_surface(depth, np.where(inside, at.x, -9), np.where(inside, at.y, -9))
    return np.where(known, between, sample_nearest(depth, at)).astype(np.float32)

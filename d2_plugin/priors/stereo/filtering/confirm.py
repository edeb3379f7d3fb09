"""What the other views say about a geometric depth: how many confirm it, through which parallax, and how closely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.geometry import (
    CONTINUOUS,
    Projection,
    ViewPair,
    index_intrinsics,
    interpolated_surface,
    view_pair,
    viewing_rays,
)
from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

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
    reference, depth = cameras[index], np.ascontiguousarray(depths[index], np.float32)
    sums = _Sums(np.zeros(depth.shape, np.uint8), np.zeros(depth.shape), np.zeros(depth.shape))
    ask = _ask_compiled if kernel.library() else ask_source
    for other, source in enumerate(cameras):
        if other != index:
            ask(sums, depth, np.ascontiguousarray(depths[other], np.float32), reference, source, settings)
    spread = np.sqrt(sums.difference / (sums.information + (sums.information == 0)))
    return Confirmation(sums.confirming, np.sqrt(sums.information), spread)


class _Sums(NamedTuple):
    """What the sources asked so far say, maps [H, W]."""

    confirming: np.ndarray
    """uint8: how many sources."""
    information: np.ndarray
    """Sum of P^2, float64."""
    difference: np.ndarray
    """Sum of P^2 times the squared relative difference, float64."""


def _ask_compiled(
    sums: _Sums,
    depth: np.ndarray,
    theirs: np.ndarray,
    reference: Camera,
    source: Camera,
    settings: StereoSettings,
) -> None:
    """`ask_source` in C++."""
    rays = np.linalg.inv(index_intrinsics(reference))
    pair, back = view_pair(reference, source), view_pair(source, reference)
    low, high = np.deg2rad(settings.min_angle), np.deg2rad(settings.max_angle)
    numbers = {
        "their_height": theirs.shape[0],
        "their_width": theirs.shape[1],
        "between": settings.between_pixels,
        "continuous": CONTINUOUS,
        "reprojection_max": settings.reprojection_max,
        "relative_depth_max": settings.relative_depth_max,
        "sine_min": np.sin(low),
        "cosine_min": np.cos(low),
        "sine_max": np.sin(high),
        "cosine_max": np.cos(high),
        "nudge": np.exp(NUDGE),
        "nudge_squared": NUDGE**2,
    }
    vectors = {"A": pair.A, "k": pair.k, "back_A": back.A, "back_k": back.k, "direction": pair.direction, "rays": rays}
    kernel.confirm(depth.shape, numbers, vectors, {"depth": depth, "theirs": theirs, **sums._asdict()})


def ask_source(
    sums: _Sums,
    depth: np.ndarray,
    theirs: np.ndarray,
    reference: Camera,
    source: Camera,
    settings: StereoSettings,
) -> None:
    """Add what one source says of `depth` [H, W] to the sums: the bits of the kernel, where there is no compiler.

    Each test is made of those alone that passed the one before.
    """
    rows, columns = np.nonzero(depth > 0)
    u, v, depth = columns.astype(np.float32), rows.astype(np.float32), depth[rows, columns]
    rays = viewing_rays(reference)[rows, columns]
    pair, way_back = view_pair(reference, source), view_pair(source, reference)
    forth = pair.project(u, v, depth)
    seen = (sample_surface if settings.between_pixels else sample_nearest)(theirs, forth)
    place = np.flatnonzero(seen > 0)
    u, v, depth, rays, seen = u[place], v[place], depth[place], rays[place], seen[place]
    forth = Projection(*(values[place] for values in forth))
    back = way_back.project(forth.x, forth.y, seen)
    off_x, off_y = back.x - u, back.y - v
    near = np.sqrt(off_x * off_x + off_y * off_y) < np.float32(settings.reprojection_max)
    near &= np.abs(back.z - depth) < np.float32(settings.relative_depth_max) * depth
    near &= _meet(rays, depth, pair, settings)
    nudged = pair.project(u[near].astype(np.float64), v[near].astype(np.float64), depth[near] * np.exp(NUDGE))
    moved_x, moved_y = nudged.x - forth.x[near], nudged.y - forth.y[near]
    squared = (moved_x * moved_x + moved_y * moved_y) / NUDGE**2
    precision = np.where(np.isfinite(squared), squared, 0)
    apart = back.z[near] / depth[near] - 1
    at = rows[place][near], columns[place][near]
    sums.confirming[at] += 1
    sums.information[at] += precision
    sums.difference[at] += precision * (apart * apart)


def _meet(rays: np.ndarray, depth: np.ndarray, pair: ViewPair, settings: StereoSettings) -> np.ndarray:
    """Whether the rays of both cameras meet at an angle that is allowed, [K].

    |a x b| and a.b are its sine and cosine times the same length. In units of the depth, so that no unit of the world
    overflows.
    """
    (x, y, z), direction = rays.T, pair.direction.astype(np.float32)
    u, v, w = x - direction[0] / depth, y - direction[1] / depth, z - direction[2] / depth
    p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
    sine, cosine = np.sqrt(p * p + q * q + r * r), x * u + y * v + z * w
    low, high = np.deg2rad(settings.min_angle), np.deg2rad(settings.max_angle)
    above = sine * np.float32(np.cos(low)) > cosine * np.float32(np.sin(low))
    return above & (sine * np.float32(np.cos(high)) < cosine * np.float32(np.sin(high)))


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

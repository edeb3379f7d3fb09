"""What the other views say about a geometric depth: how many confirm it, through which parallax, and how closely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.captures.capture import Camera
from d2_plugin.priors.geometry import Projection, angle_of_rays, interpolated_surface, view_pair, viewing_rays
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
    rows, columns = np.nonzero(depth > 0)
    points = viewing_rays(reference)[rows, columns] * depth[rows, columns][:, None]
    asked = _Asked(columns.astype(np.float32), rows.astype(np.float32), points)
    count = np.zeros(depth.shape, np.uint8)
    information, difference = np.zeros(depth.shape), np.zeros(depth.shape)
    for other, source in enumerate(cameras):
        if other == index:
            continue
        place, precision, apart = _confirmed_by(asked, reference, source, depths[other], settings)
        at = rows[place], columns[place]
        count[at] += 1
        information[at] += precision
        difference[at] += precision * apart**2
    spread = np.sqrt(difference / np.where(information > 0, information, 1))
    return Confirmation(count, np.sqrt(information), spread)


class _Asked(NamedTuple):
    """K pixels that have a depth."""

    u: np.ndarray
    """Columns [K], float32."""
    v: np.ndarray
    """Rows [K], float32."""
    points: np.ndarray
    """[K, 3] in camera coordinates; the last is planar depth."""

    def only(self, chosen: np.ndarray) -> _Asked:
        return _Asked(*(values[chosen] for values in self))


def _confirmed_by(
    asked: _Asked, reference: Camera, source: Camera, theirs: np.ndarray, settings: StereoSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(indices [C] of the pixels that a source confirms, P^2 [C], relative difference to its own depth [C]).

    Each test is made of those alone that passed the one before.
    """
    pair, way_back = view_pair(reference, source), view_pair(source, reference)
    forth = pair.project(asked.u, asked.v, asked.points[:, 2])
    seen = (sample_surface if settings.between_pixels else sample_nearest)(theirs, forth)
    place = np.flatnonzero(seen > 0)
    asked, forth = asked.only(place), Projection(*(values[place] for values in forth))
    depth = asked.points[:, 2]
    back = way_back.project(forth.x, forth.y, seen[place])
    near = np.hypot(back.x - asked.u, back.y - asked.v) < settings.reprojection_max
    near &= np.abs(back.z - depth) < settings.relative_depth_max * depth
    angle = np.rad2deg(angle_of_rays(asked.points, pair))
    confirmed = np.flatnonzero(near & (angle > settings.min_angle) & (angle < settings.max_angle))
    asked, depth = asked.only(confirmed), depth[confirmed]
    nudged = pair.project(asked.u, asked.v, depth * np.exp(NUDGE))
    parallax = np.hypot(nudged.x - forth.x[confirmed], nudged.y - forth.y[confirmed]) / NUDGE
    return place[confirmed], np.where(np.isfinite(parallax), parallax**2, 0), back.z[confirmed] / depth - 1


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

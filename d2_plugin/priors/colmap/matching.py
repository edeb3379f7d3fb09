"""Features of two images matched under known poses: mutual nearest neighbours on each other's epipolar lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.recording import Camera

MAX_RATIO = 0.8
"""Largest angle to the best match over the angle to the second best (Lowe's ratio test)."""
MAX_ANGLE = 0.7
"""Largest angle between matching descriptors, radians."""


class Features(NamedTuple):
    """Feature points of one image."""

    pixels: np.ndarray  # [F, 2] float64, pixel centres at i + 0.5
    descriptors: np.ndarray  # [F, 128] float32, unit length


def epipolar_matches(
    first: Features,
    second: Features,
    fundamental: np.ndarray,
    max_error: float,
) -> np.ndarray:
    """Pairs of feature indices [M, 2] that are each other's nearest, unambiguous, and fit the known geometry.

    Args:
        first, second: features of the two images.
        fundamental: F [3, 3], see `fundamental_matrix`.
        max_error: largest `sampson_distance`, pixels.
    """
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), np.int64)
    forward = _nearest(first.descriptors, second.descriptors)
    backward = _nearest(second.descriptors, first.descriptors)
    here = np.flatnonzero(forward >= 0)
    here = here[backward[forward[here]] == here]
    matches = np.stack([here, forward[here]], axis=1)
    error = sampson_distance(fundamental, first.pixels[matches[:, 0]], second.pixels[matches[:, 1]])
    return matches[error <= max_error]


def _nearest(queries: np.ndarray, candidates: np.ndarray, block: int = 1024) -> np.ndarray:
    """Index of the candidate nearest to each query [Q], -1 where it is too far or a second one is as near."""
    nearest = np.full(len(queries), -1)
    for start in range(0, len(queries), block):
        similarity = queries[start : start + block] @ candidates.T
        best, rows = similarity.argmax(axis=1), np.arange(len(similarity))
        angle = np.arccos(np.clip(similarity[rows, best], -1, 1))
        similarity[rows, best] = -np.inf
        second = np.arccos(np.clip(similarity.max(axis=1), -1, 1))
        clear = (angle <= MAX_ANGLE) & (angle <= MAX_RATIO * second)
        nearest[start : start + block] = np.where(clear, best, -1)
    return nearest


def sampson_distance(fundamental: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """First-order distance [M] in pixels of matched points [M, 2] from the epipolar geometry F [3, 3]."""
    x, y = (np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (first, second))
    line_second, line_first = x @ fundamental.T, y @ fundamental
    gradient = np.hypot(np.hypot(*line_second[:, :2].T), np.hypot(*line_first[:, :2].T))
    return np.abs((y * line_second).sum(axis=1)) / np.maximum(gradient, np.finfo(float).tiny)


def _relative_pose(first: Camera, second: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(R, t) from the first camera's coordinates to the second's."""
    pose = second.T_camera_world @ np.linalg.inv(first.T_camera_world)
    return pose[:3, :3], pose[:3, 3]


def same_spot(first: Camera, second: Camera) -> bool:
    """Whether two cameras stand on the same spot, up to rounding: they see no parallax."""
    baseline = np.linalg.norm(first.centre - second.centre)
    return bool(baseline <= 1e-9 * max(1.0, np.abs(first.centre).max()))


def fundamental_matrix(first: Camera, second: Camera) -> np.ndarray:
    """F [3, 3] with y^T F x = 0 for pixels x of `first` and y of `second` of one world point."""
    rotation, (x, y, z) = _relative_pose(first, second)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(second.K).T @ cross @ rotation @ np.linalg.inv(first.K)

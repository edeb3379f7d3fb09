"""How much brighter or redder one camera sees the same surface points than the others do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.recording import Camera, Recording

DARK, BRIGHT = 10, 245  # values of a pixel, of 255, beyond which a channel says nothing about gain: noise, or clipped
FEWEST = 20  # points that a camera must share with others


class Exposures(NamedTuple):
    """Gains of the cameras relative to their mean, and how sure they are."""

    gains: np.ndarray  # [C, 3] logarithm of each channel's gain
    errors: np.ndarray  # [C, 3] standard error
    points: int  # the smallest number of points behind a gain

    @property
    def largest(self) -> tuple[float, float]:
        """The largest gain in size, and its standard error."""
        worst = int(np.abs(self.gains).argmax())
        return float(abs(self.gains.flat[worst])), float(self.errors.flat[worst])


def relative_exposures(
    recording: Recording, cameras: Sequence[str], positions: np.ndarray, times: np.ndarray
) -> Exposures | None:
    """Compare what the cameras see at surface points; None where some camera shares fewer than `FEWEST` with others.

    At each point a camera's logarithm of brightness is held against the median over the cameras, and the median over
    the points is its gain: hidden points and highlights are outliers of both.

    Args:
        cameras: whom to compare; at least two.
        positions, times: points [P, 3] in the world and the seconds at which each was seen.
    """
    seen = np.stack([_brightness(recording, camera, positions, times) for camera in cameras])  # [C, P, 3]
    shared = np.isfinite(seen).sum(0) >= 2
    seen = np.where(shared, seen, np.nan)
    counts = np.isfinite(seen).sum(1)
    if len(cameras) < 2 or not counts.size or counts.min() < FEWEST:
        return None
    kept = shared.any(1)
    off = seen[:, kept] - _median(seen[:, kept], 0)
    gains = _median(off, 1)
    spread = 1.4826 * _median(np.abs(off - gains[:, None]), 1)
    return Exposures(gains - gains.mean(0), 1.2533 * spread / np.sqrt(counts), int(counts.min()))


def _median(values: np.ndarray, axis: int) -> np.ndarray:
    """The median of what is finite; a channel of a point that nobody shares is NaN, without a warning."""
    return np.ma.median(np.ma.masked_invalid(values), axis=axis).filled(np.nan)


def _brightness(recording: Recording, camera: str, positions: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Logarithm of each channel [P, 3] around the points' pixels; NaN where one says nothing."""
    logarithms = np.full((len(positions), 3), np.nan)
    seconds = np.array([recording.seconds(frame) for frame in recording.frames])
    nearest = np.abs(seconds[:, None] - times).argmin(0)
    columns, rows, inside = _pixels(recording.cameras[camera], positions)
    for index in np.unique(nearest):
        here = inside & (nearest == index)
        image = recording.image(camera, recording.frames[index]).astype(float)
        values = _around(image, rows[here], columns[here])
        logarithms[here] = np.where((values > DARK) & (values < BRIGHT), np.log(np.maximum(values, 1)), np.nan)
    return logarithms


def _around(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Means of 3x3 pixels: a point is not known to the pixel."""
    steps = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    return np.mean([image[rows + y, columns + x] for y, x in steps], axis=0)


def _pixels(camera: Camera, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows [P] of points, and whether they lie in front of the camera and a pixel inside its image."""
    points = positions @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    ahead = points[:, 2] > 1e-9
    screen = points @ camera.K.T / np.where(ahead, points[:, 2], 1)[:, None]
    size = np.array([camera.width, camera.height])
    inside = ahead & (screen[:, :2] >= 1).all(1) & (screen[:, :2] < size - 1).all(1)
    columns, rows = np.where(inside[:, None], screen[:, :2], 1).astype(int).T
    return columns, rows, inside

"""What moves in two images, per half-plane through the line that joins their cameras, and how alike that is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.recording import Camera

PLANES, GROUPS = 48, 4
"""Half-planes between the common limits of two images; the offsets are found again without each group of them."""

FINE = 8
"""Steps per frame in which lags are compared; between them lies a parabola."""

NOISE = (2.0, 3.0)
"""Change counts above this many times a pixel's usual change, and this many levels of 255 more."""

LEAST_COMMON = 5
"""Frames that two cameras must share at a lag."""


class Watched(NamedTuple):
    """Small images of a camera that stands still."""

    camera: Camera
    """The pinhole of the small images."""
    images: np.ndarray
    """[T, h, w] uint8, brightness."""
    times: np.ndarray
    """[T] seconds on the clock of the video."""


class Curve(NamedTuple):
    """How well two cameras agree at each lag, by group of half-planes."""

    lags: np.ndarray  # [L] in steps: the clock of the other began so much later
    products: np.ndarray  # [G, L]
    squares: np.ndarray  # [2, G, L]
    common: np.ndarray  # [L] frames

    def correlation(self, without: int | None = None) -> np.ndarray:
        """[L], NaN where too few frames are common; `without` leaves out a group."""
        kept = [group for group in range(len(self.products)) if group != without]
        size = np.sqrt(np.prod(self.squares[:, kept].sum(1), axis=0))
        with np.errstate(invalid="ignore", divide="ignore"):
            found = self.products[kept].sum(0) / size
        return np.where((self.common >= LEAST_COMMON) & (size > 1e-9), found, np.nan)

    def score(self, without: int | None = None) -> np.ndarray:
        """[L] Fisher's z of the correlation times the root of the common frames: a chance peak counts less."""
        return np.nan_to_num(np.arctanh(np.clip(self.correlation(without), -0.999, 0.999)) * np.sqrt(self.common))


def changes_of(one: Watched) -> tuple[np.ndarray, np.ndarray]:
    """(change per second [T - 1, h, w] beyond what is usual for the pixel, the instants [T - 1] in the middle)."""
    steps = np.diff(one.times)
    change = np.abs(np.diff(one.images.astype(np.int16), axis=0)).astype(np.float32)
    usual = np.median(change, axis=0)
    change = np.maximum(change - NOISE[0] * usual - NOISE[1], 0) * (np.median(steps) / steps)[:, None, None]
    return change.astype(np.float32), (one.times[1:] + one.times[:-1]) / 2


def curve_between(
    one: Watched, other: Watched, changes: tuple, other_changes: tuple, step: float, search: float
) -> Curve | None:
    """The agreement of two cameras over the lag; None where no half-plane is in both images."""
    angles = _angles(one.camera, other.camera)
    low, high = (pick(bound(angle, q) for angle in angles) for pick, bound, q in ((max, _at, 0.01), (min, _at, 0.99)))
    if not high > low:
        return None
    profiles = [
        _resampled(_profile(change, angle, low, high), times, step)
        for (change, times), angle in zip((changes, other_changes), angles)
    ]
    starts = (float(changes[1][0]), float(other_changes[1][0]))
    return _correlated(profiles[0], profiles[1], starts, step, search)


def _at(angles: np.ndarray, share: float) -> float:
    return float(np.nanquantile(angles, share))


def _angles(one: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Angle [h, w] of each pixel's half-plane around the line that joins the cameras; NaN next to that line."""
    axis = other.centre - one.centre
    axis /= np.linalg.norm(axis) + 1e-300
    ahead = one.T_camera_world[2, :3] + other.T_camera_world[2, :3]
    ahead = ahead - axis * (axis @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # the cameras look at each other: any direction across the line will do
        ahead = np.cross(axis, one.T_camera_world[0, :3])
    ahead /= np.linalg.norm(ahead)
    across = np.cross(axis, ahead)

    def of(camera: Camera) -> np.ndarray:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.T_camera_world[:3, :3]
        off = np.hypot(rays @ ahead, rays @ across) / np.linalg.norm(rays, axis=-1)
        return np.where(off > 0.1, np.arctan2(rays @ across, rays @ ahead), np.nan)

    return of(one), of(other)


def _profile(change: np.ndarray, angles: np.ndarray, low: float, high: float) -> np.ndarray:
    """Mean change [T, PLANES] of the pixels of each half-plane."""
    with np.errstate(invalid="ignore"):
        place = np.floor((angles - low) / (high - low) * PLANES)
        inside = (place >= 0) & (place < PLANES)
    places = place[inside].astype(int)
    pixels = np.maximum(np.bincount(places, minlength=PLANES), 1)
    rows = change[:, inside]
    return np.stack([np.bincount(places, row, minlength=PLANES) for row in rows]) / pixels


def _resampled(profile: np.ndarray, times: np.ndarray, step: float) -> np.ndarray:
    """The profile [N, PLANES] every `step` seconds from its first instant on, linear between."""
    wanted = np.arange(times[0], times[-1] + step / 2, step)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    share = ((wanted - times[after - 1]) / (times[after] - times[after - 1])).clip(0, 1)[:, None]
    return profile[after - 1] * (1 - share) + profile[after] * share


def _correlated(one: np.ndarray, other: np.ndarray, starts: tuple[float, float], step: float, search: float) -> Curve:
    """Sums over the common time at every lag: products and squares about the means of that time."""
    a, b = len(one), len(other)
    shifts = np.arange(-(b - 1), a)  # sample i + shift of `one` meets sample i of `other`
    begin, end = np.maximum(shifts, 0), np.minimum(a, b + shifts)
    count = end - begin
    size = 1 << int(np.ceil(np.log2(a + b)))
    spectra = np.fft.rfft(one, size, axis=0) * np.conj(np.fft.rfft(other, size, axis=0))
    product = np.fft.irfft(spectra, size, axis=0)[shifts % size]
    sums, squares = zip(*(_running(one, begin, end), _running(other, begin - shifts, end - shifts)))
    product = product - sums[0] * sums[1] / count[:, None]
    spreads = [square - total**2 / count[:, None] for square, total in zip(squares, sums)]
    lags = shifts + (starts[0] - starts[1]) / step
    kept = np.abs(lags) <= search / step + 1

    def grouped(values: np.ndarray) -> np.ndarray:
        return np.stack([part.sum(1) for part in np.array_split(values[kept], GROUPS, axis=1)])

    return Curve(lags[kept], grouped(product), np.stack([grouped(s) for s in spreads]), count[kept] / FINE)


def _running(values: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the values, and of their squares, from `begin` to `end`."""
    both = []
    for power in (values, values**2):
        total = np.vstack([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
        both.append(total[end] - total[begin])
    return both[0], both[1]

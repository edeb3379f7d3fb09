"""Each camera's gain, from pixels of two cameras that show the same point of a surface.

Features of two images of one instant are matched, and kept where they lie on the epipolar lines of the calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from d2_plugin.recordings.cameras.epipolar import epipolar_lines, homogeneous, sampson, sift_features
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.clocks import linked_names
from d2_plugin.recordings.recording import Camera, Exposure, Recording
from d2_plugin.recordings.selection import spread

FRAMES = 6  # instants at which features are looked for, at most
KNOWN = 0.004  # standard error of all gains at which no more instants are looked at
FEATURES = 3000  # of an image, at most
DIAGONAL = 1 / 800  # of the image: how far two features may lie from places that a calibration allows
DISTINCT = 0.8  # A match is kept where the second best is this much farther away (Lowe 2004)

LIKELY = 380.0
"""A match whose descriptor differs by more than `DISTINCT` times this is none: SIFT's have the length 512."""

FEWEST = 20  # matches of two cameras, over all instants, that a gain takes
DARK, BRIGHT = 10, 245  # values of a pixel, of 255, beyond which a channel says nothing about gain: noise, or clipped


def measured_exposures(recording: Recording, cameras: Sequence[str]) -> dict[str, Exposure]:
    """Gains relative to their geometric mean, of the largest group of cameras that share `FEWEST` matches; maybe none.

    The logarithms of the ratios of each pair, the median over its matches, are weighed by their errors.
    """
    ratios: dict[tuple[str, str], list[np.ndarray]] = {}
    gains: dict[str, Exposure] = {}
    for frame in spread(recording.frames, FRAMES):
        images = {name: recording.image(name, frame) for name in cameras}
        features = {name: sift_features(image, FEATURES, "measuring exposure")[:2] for name, image in images.items()}
        for one, other in combinations(cameras, 2):
            p, q = _matched(recording.cameras[one], recording.cameras[other], features[one], features[other])
            if len(p):
                a, b = _around(images[one], p), _around(images[other], q)
                ratios.setdefault((one, other), []).append(b - a)
        joined = {pair: np.concatenate(parts) for pair, parts in ratios.items()}
        gains = _gains(cameras, {pair: _middle(values) for pair, values in joined.items() if len(values) >= FEWEST})
        if len(gains) == len(cameras) and max(max(one.error) for one in gains.values()) < KNOWN:
            break
    return gains


_Features = tuple[np.ndarray, np.ndarray]


def _matched(one: Camera, other: Camera, features: _Features, others: _Features) -> _Features:
    """Places [n, 2] of the same points in two images: each is the other's best by far along its epipolar line."""
    (p, descriptors), (q, other_descriptors) = features, others
    if not len(p) or not len(q) or np.allclose(one.centre, other.centre):
        return np.zeros((0, 2)), np.zeros((0, 2))
    reach = max(DIAGONAL * np.hypot(other.width, other.height), 0.7)
    off = epipolar_lines(one, other, p).astype(np.float32) @ homogeneous(q).T.astype(np.float32)
    squares = (descriptors**2).sum(1)[:, None] + (other_descriptors**2).sum(1) - 2 * descriptors @ other_descriptors.T
    squares[np.abs(off) > 2 * reach] = np.inf
    best, back = squares.argmin(1), squares.argmin(0)
    two = np.partition(squares, 1, axis=1)[:, :2] if len(q) > 1 else squares[:, [0, 0]]
    first, second = np.sqrt(np.maximum(two, 0)).T
    kept = np.isfinite(first) & (first < DISTINCT * np.minimum(second, LIKELY)) & (back[best] == np.arange(len(p)))
    p, q = p[kept], q[best[kept]]
    near = np.abs(sampson(one, other, p, q)) < reach
    return p[near], q[near]


def _around(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Logarithm [n, 3] of the mean of some pixels around each place; NaN where one says nothing."""
    cv2 = opencv("measuring exposure")
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    values = cv2.remap(smooth, (places - 0.5).astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]
    return np.where((values > DARK) & (values < BRIGHT), np.log(np.maximum(values, 1)), np.nan)


def _middle(ratios: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(median [3], its standard error [3]) of ratios [n, 3]."""
    middle = np.nanmedian(ratios, axis=0)
    spread = 1.4826 * np.nanmedian(np.abs(ratios - middle), axis=0)
    return middle, 1.2533 * spread / np.sqrt(np.isfinite(ratios).sum(axis=0)) + 1e-4


def _gains(cameras: Sequence[str], pairs: dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]) -> dict[str, Exposure]:
    """Weighted least squares over the pairs, the mean of the logarithms 0."""
    pairs = {pair: values for pair, values in pairs.items() if np.isfinite(values).all()}
    names = linked_names(cameras, pairs)
    kept = [pair for pair in pairs if pair[0] in names and pair[1] in names]
    if len(names) < 2:
        return {}
    signs = np.array([[(name == other) - float(name == one) for name in names] for one, other in kept])
    logs, errors = np.zeros((len(names), 3)), np.zeros((len(names), 3))
    for channel in range(3):
        middle, error = np.array([[part[channel] for part in pairs[pair]] for pair in kept]).T
        rows, goal = signs / error[:, None], middle / error
        inverse = np.linalg.pinv(rows.T @ rows)  # of all solutions the smallest, whose mean is 0
        logs[:, channel] = inverse @ rows.T @ goal
        # Pairs that contradict each other by more than their errors say that those are too small.
        free = len(kept) - len(names) + 1
        excess = float(((rows @ logs[:, channel] - goal) ** 2).sum()) / free if free > 0 else 1.0
        errors[:, channel] = np.sqrt(np.maximum(np.diag(inverse), 0) * max(excess, 1.0))
    gains = np.exp(logs)
    return {name: Exposure(_three(gains[i]), _three(gains[i] * errors[i])) for i, name in enumerate(names)}


def _three(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue

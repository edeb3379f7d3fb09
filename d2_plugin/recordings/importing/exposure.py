"""Each camera's gain, from pixels of two cameras that show the same point of a surface.

Features of two images of one instant are matched, and kept where the calibration allows both places.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d2_plugin.recordings.cameras.calibrating.features import find_features, match_all
from d2_plugin.recordings.cameras.epipolar import sampson
from d2_plugin.recordings.checks.exposure import BRIGHT, DARK
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.clocks import linked_names
from d2_plugin.recordings.recording import Exposure, Recording
from d2_plugin.recordings.selection import spread

FRAMES = 6  # instants at which features are looked for, at most
KNOWN = 0.004  # standard error of all gains at which no more instants are looked at
DIAGONAL = 1 / 800  # of the image: how far two features may lie from places that a calibration allows

FEWEST = 20  # matches of two cameras, over all instants, that a gain takes


def measured_exposures(recording: Recording, cameras: Sequence[str]) -> dict[str, Exposure]:
    """Gains relative to their geometric mean, of the largest group of cameras that share `FEWEST` matches; maybe none.

    The logarithms of the ratios of each pair, the median over its matches, are weighed by their errors.
    """
    ratios: dict[tuple[str, str], list[np.ndarray]] = {}
    gains: dict[str, Exposure] = {}
    for frame in spread(recording.frames, FRAMES):
        images = {name: recording.image(name, frame) for name in cameras}
        features = {name: find_features([image]) for name, image in images.items()}
        for (one, other), matches in match_all(features).items():
            p, q = features[one].pixels[matches[:, 0]], features[other].pixels[matches[:, 1]]
            a, b = recording.cameras[one], recording.cameras[other]
            near = np.abs(sampson(a, b, p, q)) < max(DIAGONAL * np.hypot(b.width, b.height), 0.7)
            if near.any():
                ratio = _around(images[other], q[near]) - _around(images[one], p[near])
                ratios.setdefault((one, other), []).append(ratio)
        joined = {pair: np.concatenate(parts) for pair, parts in ratios.items()}
        gains = _gains(cameras, {pair: _middle(values) for pair, values in joined.items() if len(values) >= FEWEST})
        if len(gains) == len(cameras) and max(max(one.error) for one in gains.values()) < KNOWN:
            break
    return gains


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

"""Whether each camera stood still and kept its exposure from the beginning of its video to its end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Recording

LONG_SIDE = 320  # pixels of the images that are compared
MOVED = 1.5  # of these pixels: a camera was moved
EXPLAINS = 0.7  # what moves the image back leaves at most this part of the difference
DRIFT = 0.05  # share by which the exposure may change unmentioned
USABLE = (10, 245)  # brightness of pixels, of 255, that say something about a gain


class Steadiness(NamedTuple):
    """Of one camera."""

    moved: float  # share of its image's width by which that jumped; 0 where it stood still
    between: tuple[float, float]  # seconds of the recording between which it was moved
    drift: float  # brightest over darkest exposure, less 1


def steadiness(recording: Recording) -> dict[str, Steadiness]:
    """What some images say of each camera; medians over time hide what moves before it."""
    return {name: _steadiness(recording, name) for name in recording.cameras}


def _steadiness(recording: Recording, camera: str) -> Steadiness:
    cv2, width = opencv("comparing images over time"), recording.cameras[camera].width
    scale = max(max(width, recording.cameras[camera].height) / LONG_SIDE, 1.0)
    greys = [cv2.cvtColor(recording.image(camera, frame), cv2.COLOR_RGB2GRAY) for frame in recording.frames]
    small = [cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA) for grey in greys]
    images = np.stack(small).astype(np.float32)
    still = np.median(images, axis=0)
    usable = (images > USABLE[0]) & (images < USABLE[1])
    gains = np.array(
        [np.median((image / np.maximum(still, 1))[mask]) if mask.any() else 1.0 for image, mask in zip(images, usable)]
    )
    images /= np.maximum(gains, 1e-3)[:, None, None]
    jumps = [_jump(np.median(images[:k], axis=0), np.median(images[k:], axis=0)) for k in range(1, len(images))]
    moved = max(jumps, default=0.0)
    changes = np.abs(np.diff(images, axis=0)).mean(axis=(1, 2))
    largest = int(changes.argmax()) if len(changes) else 0
    seconds = np.array(recording.frames) / recording.fps  # from frame 0, as --times counts them
    between = float(seconds[largest]), float(seconds[min(largest + 1, len(seconds) - 1)])
    drift = float(gains.max() / max(gains.min(), 1e-3) - 1)
    return Steadiness(moved / images.shape[2], between, drift) if moved > MOVED else Steadiness(0.0, between, drift)


def _jump(before: np.ndarray, after: np.ndarray) -> float:
    """Pixels by which the second image is shifted, where that explains how it differs from the first."""
    cv2 = opencv("comparing images over time")
    (x, y), _ = cv2.phaseCorrelate(before, after, cv2.createHanningWindow(before.shape[::-1], cv2.CV_32F))
    back = cv2.warpAffine(
        after, np.array([[1, 0, -x], [0, 1, -y]], np.float32), before.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    inner = tuple(slice(round(abs(shift)) + 1, -round(abs(shift)) - 1) for shift in (y, x))
    left, there = (float(np.abs(one - before)[inner].mean()) if one[inner].size else np.inf for one in (back, after))
    return float(np.hypot(x, y)) if left < EXPLAINS * there else 0.0

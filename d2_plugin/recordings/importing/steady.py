"""Whether each camera stood still and kept its exposure from the beginning of its video to its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.video import Decoder, VideoFile
from d2_plugin.recordings.selection import spread

MOMENTS = 9  # images of each video, spread over it
LONG_SIDE = 320  # pixels of the images that are compared
MOVED = 1.5  # of these pixels: a camera was moved
EXPLAINS = 0.7  # what moves the image back leaves at most this part of the difference
DRIFT = 0.05  # share by which the exposure may change unmentioned
USABLE = (10, 245)  # brightness of pixels, of 255, that say something about a gain


class Steadiness(NamedTuple):
    """Of one camera."""

    moved: float  # pixels of the video by which its image jumped; 0 where it stood still
    between: tuple[float, float]  # seconds of the video between which it was moved
    drift: float  # brightest over darkest exposure, less 1


def steadiness(videos: Mapping[str, VideoFile], indices: Mapping[str, Mapping[int, int]]) -> dict[str, Steadiness]:
    """What some of the images say that are taken of each video; medians over time hide what moves before the camera."""
    return {name: _steadiness(video, sorted(set(indices[name].values()))) for name, video in videos.items()}


def _steadiness(video: VideoFile, taken: Sequence[int]) -> Steadiness:
    places = spread(taken, MOMENTS)
    decoder = Decoder(video)
    images = np.stack([decoder.grey(place, LONG_SIDE) for place in places]).astype(np.float32)
    decoder.close()
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
    seconds = video.times - video.times[0]
    scale = max(video.stored_size) / max(images.shape[1:])
    between = (float(seconds[places[largest]]), float(seconds[places[min(largest + 1, len(places) - 1)]]))
    drift = float(gains.max() / max(gains.min(), 1e-3) - 1)
    return Steadiness(moved * scale if moved > MOVED else 0.0, between, drift)


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

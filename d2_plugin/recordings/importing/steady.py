"""Whether each camera stood still and kept its exposure from the beginning of its video to its end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.cameras.epipolar import Sift, sift_features
from d2_plugin.recordings.checks.exposure import BRIGHT, DARK
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Recording

LONG_SIDE = 320  # pixels of the images that are compared
MOVED = 0.5  # of these pixels: a camera was moved. One that stands still is within .1 of them, half a degree is .7
FEWEST = 12  # features that must have moved together
CONTRAST = 0.02  # of these, at least: half of OpenCV's
SPREAD = 0.4  # part of the image's width and height over which these lie, at least: what is held up does not
TELLS = 5.0  # levels of 255 by which a pixel must change where the image is moved back, to say whether that is right
EXPLAINS = 0.6  # share of these that say so, at least: where a person walks the wall behind him does not
DRIFT = 0.05  # share by which the exposure may change unmentioned


class Steadiness(NamedTuple):
    """Of one camera."""

    moved: float  # share of its image's width by which that jumped; 0 where it stood still
    between: tuple[float, float]  # seconds of the recording between which it was moved
    drift: float  # brightest over darkest exposure, less 1


def steadiness(recording: Recording, camera: str) -> Steadiness:
    """What some images say of a camera; medians over time hide what moves before it."""
    cv2 = opencv("comparing images over time")
    scale = max(max(recording.cameras[camera].width, recording.cameras[camera].height) / LONG_SIDE, 1.0)
    taken = (recording.image(camera, frame) for frame in recording.frames)
    small = [cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA) for image in taken]
    images = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in small]).astype(np.float32)
    still = np.median(images, axis=0)
    usable = (images > DARK) & (images < BRIGHT)
    gains = np.array(
        [np.median((image / np.maximum(still, 1))[mask]) if mask.any() else 1.0 for image, mask in zip(images, usable)]
    )
    images /= np.maximum(gains, 1e-3)[:, None, None]
    features = [sift_features(image, 500, "comparing images over time", CONTRAST) for image in small]
    jumps = np.array([_jump(images[[0, k]], features[0], features[k]) for k in range(len(images))])
    later = int((jumps > MOVED).argmax())  # the first that was moved; 0 where none was
    before = int(np.flatnonzero(jumps[: later + 1] <= MOVED)[-1]) if later else 0
    first, last = (recording.frames[k] / recording.fps for k in (before, later))  # from frame 0, as --times counts them
    drift = float(gains.max() / max(gains.min(), 1e-3) - 1)
    moved = float(np.nanmax(jumps)) / images.shape[2] if later else 0.0
    return Steadiness(moved, (first, last), drift)


def _jump(images: np.ndarray, before: Sift, after: Sift) -> float:
    """Pixels by which features of the second image moved together, NaN where it cannot be told.

    A similarity, so a camera that was turned about its own axis is noticed as well.
    """
    cv2 = opencv("comparing images over time")
    matches = cv2.BFMatcher(crossCheck=True).match(before[1], after[1])
    p = before[0][[match.queryIdx for match in matches]] - 0.5  # OpenCV puts centres at whole numbers
    q = after[0][[match.trainIdx for match in matches]] - 0.5
    if len(p) < FEWEST:
        return np.nan
    back, inside = cv2.estimateAffinePartial2D(q, p, ransacReprojThreshold=1.0)
    if back is None or inside.sum() < FEWEST:
        return np.nan
    p, q = p[inside.ravel() > 0], q[inside.ravel() > 0]
    if (np.ptp(p, axis=0) < SPREAD * np.array(images[1].shape[::-1])).any():
        return np.nan
    jump = float(np.median(np.linalg.norm(p - q, axis=1)))
    moved = cv2.warpAffine(images[1], back, images[1].shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    left, there = (np.abs(one - images[0]) for one in (moved, images[1]))
    tells = np.abs(moved - images[1]) > TELLS
    return jump if jump <= MOVED or (left < there)[tells].mean() > EXPLAINS else np.nan

"""Stereo at pixels that show another colour than the surface which it gives them; an addition to the paper.

Matching compares windows. On a thing that is thinner than they are, most of a window shows what lies behind it: pixels
of a pole get the depth of the wall, and other cameras confirm it, as the wall is there. They show it in its own colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from d2_plugin.priors.cross_view.kernel import DARK, FEWEST, ONE_PLACE
from d2_plugin.priors.geometry import projected
from d2_plugin.protocol import Label
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.maps import FusedPrior

MOST, TIMES = 0.9, 4.0
"""Cameras differ by more than exposure: another colour is off by four times what nine tenths of a view's pixels are."""


def without_other_colors(
    priors: Mapping[str, FusedPrior], cameras: Mapping[str, Camera], limit: float
) -> dict[str, FusedPrior]:
    """The priors of one instant without verified pixels whose colour no camera that knows the same depth there has.

    Args:
        priors: D* of synchronized views, by camera.
        cameras: their calibrations.
        limit: how far a colour (0..1, mean of the channels) may lie outside of those of 3x3 pixels of the other
            camera, by whose exposure it is changed; more where a tenth of a view's colours lie far outside.
    """
    cv2, square = opencv("the colours of stereo"), np.ones((3, 3), np.uint8)
    images = {name: prior.colors for name, prior in priors.items() if prior.colors is not None}
    ranges = {name: (cv2.erode(image, square), cv2.dilate(image, square)) for name, image in images.items()}
    found = dict(priors)
    for name, image in images.items():
        prior = priors[name]
        rows, columns = np.nonzero(prior.labels == Label.VERIFIED)
        if not len(rows):
            continue
        points = cameras[name].world(np.stack([columns, rows], -1) + 0.5, prior.depth[rows, columns])
        color, least = image[rows, columns].astype(np.float32), np.full(len(rows), np.inf, np.float32)
        for other in (other for other in images if other != name):
            pixels, depths, seen = projected(cameras[other], points)
            shown = np.flatnonzero(seen)
            across, down = pixels[shown].astype(int).T
            known = priors[other].depth[down, across] * (priors[other].labels[down, across] == Label.VERIFIED)
            same = np.abs(known - depths[shown]) < ONE_PLACE * depths[shown]
            shown, across, down = shown[same], across[same], down[same]
            ours = color[shown] * _gain(color[shown], images[other][down, across])
            low, high = (bound[down, across] for bound in ranges[other])
            outside = np.fmax(np.fmax(low - ours, ours - high), 0).mean(1) / 255
            least[shown] = np.fmin(least[shown], outside)
        compared = np.isfinite(least)
        usual = np.quantile(least[compared], MOST) if compared.any() else 0.0
        gone = np.zeros(prior.labels.shape, bool)
        gone[rows, columns] = compared & (least > max(limit, TIMES * usual))
        found[name] = replace(
            prior,
            labels=np.where(gone, np.uint8(Label.EMPTY), prior.labels),
            depth=np.where(gone, np.float32(0), prior.depth),
            sigma=np.where(gone, np.float32(np.inf), prior.sigma),
        )
    return found


def _gain(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """By how much the channels [3] of a camera are brighter than ours, of colours [K, 3] of the same places."""
    light = (ours > DARK).all(1) & (theirs > DARK).all(1)
    if np.count_nonzero(light) < FEWEST:
        return np.ones(3, np.float32)
    gain: np.ndarray = np.median(theirs[light] / ours[light], axis=0).astype(np.float32)
    return gain

"""The final filter of geometric depth, the same for every matcher: it decides which depths may act as anchors.

A depth survives when it matched well, where there is texture to match, when it lies on one surface with its
neighbours, when enough other views confirm it by a forward-backward reprojection and by their own depth, when the rays
of a confirming view meet at an angle, and when it is not a speckle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.filtering.confirm import RELATIVE_DEPTH, confirm
from d2_plugin.priors.stereo.filtering.precision import geometric_sigma, grey_gradient
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

COST_MAX = 0.5
"""A depth survives when its matching cost 1 - NCC is below this."""
TEXTURE_WINDOW = 11
"""Side of the window in which texture is measured, pixels."""
TEXTURE_MIN = 0.005
"""A depth survives where the grey value's standard deviation in the window exceeds this, in 0..1. Only windows without
any texture are refused, because coherence tells wrong matches better; OpenMVS, without it, asks for .02."""
COHERENCE_MIN = 0.57
"""A depth survives when this share of its neighbours lies on its tangent plane."""
PLAUSIBLE = 0.5
"""From this share on a match that other views do not confirm may still be confirmed by a network's map."""
REACH = 9
"""Half the side of the square window of coherence, pixels, a multiple of `STRIDE`."""
CONTRAST = 0.05
"""Standard deviation of the weight over grey values, in 0..1: neighbours that differ by more have little say."""
STRIDE = 3  # pixels between the neighbours that are compared
SLOPE_REACH = 2  # pixels between the ends of a difference: shorter ones amplify noise, longer ones cross edges
SPECKLE_SIZE = 20
"""Connected pieces of the depth map with fewer pixels are dropped."""

NEVER = np.float32(1e3)
"""Beyond any logarithm of a float32 depth: neutral in a minimum."""


@dataclass(frozen=True, eq=False)
class GeometricDepth:
    """D^g of one view after filtering.

    `depth` [H, W] float32 is planar z, 0 where nothing survived (the complement of Omega^g); `sigma` [H, W] float32 is
    its relative standard deviation, infinite where there is none; `unconfirmed` [H, W] float32 are matches elsewhere
    that lack the word of another view alone, 0 where there is none; `record` is what is stored beside them, as plain
    values: under `survivors` how many pixels were left after each test, in order.
    """

    depth: np.ndarray
    sigma: np.ndarray
    unconfirmed: np.ndarray
    record: dict[str, Any]


def filter_depths(
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    costs: Sequence[np.ndarray],
    settings: StereoSettings,
    tolerance: float = RELATIVE_DEPTH,
) -> list[GeometricDepth]:
    """Apply all tests to the raw maps of one timestamp.

    Args:
        grays: uint8 [H, W] per camera.
        depths: raw planar depth float32 [H, W] per camera, 0 or NaN where the matcher has none.
        costs: matching cost 1 - NCC float32 [H, W] per camera.
        tolerance: depths of one surface differ by less than this share.

    Returns:
        One `GeometricDepth` per camera. Nothing survives where no source can confirm it.
    """
    # Products with masks where nothing is infinite: NumPy's choice takes ten times as long.
    known = [_finite(depth) for depth in depths]
    matched = [depth * (cost < COST_MAX) for depth, cost in zip(known, costs)]
    textured = [depth * texture_mask(gray) for gray, depth in zip(grays, matched)]
    # Neighbours in the unfiltered map: one that matched badly may still tell where the surface runs.
    coherent = [surface_coherence(gray, depth, tolerance) for gray, depth in zip(grays, known)]
    candidates = [z * (share >= COHERENCE_MIN) for share, z in zip(coherent, textured)]
    results = []
    for index, gray in enumerate(grays):
        confirmation = confirm(index, cameras, candidates, settings, tolerance)
        needed = min(settings.min_sources, len(cameras) - 1)
        confirmed = candidates[index] * (confirmation.sources >= max(needed, 1))
        final = remove_speckles(confirmed, tolerance)
        survivors = {
            "pixels": gray.size,
            "matched": int(np.count_nonzero(matched[index] > 0)),
            "textured": int(np.count_nonzero(textured[index] > 0)),
            "coherent": int(np.count_nonzero(candidates[index] > 0)),
            "confirmed": int(np.count_nonzero(confirmed > 0)),
            "kept": int(np.count_nonzero(final > 0)),
        }
        evidence = (coherent[index], confirmation.parallax, confirmation.spread, grey_gradient(gray))
        sigma = geometric_sigma(final, *evidence)
        unconfirmed = textured[index] * ((coherent[index] >= PLAUSIBLE) & (final == 0))
        results.append(GeometricDepth(final, sigma, unconfirmed, {"survivors": survivors}))
    return results


def _finite(depth: np.ndarray) -> np.ndarray:
    """A raw map as float32, 0 where it has no depth."""
    known = np.fmax(depth, 0, dtype=np.float32)
    known[known == np.inf] = 0
    return known


def texture_mask(gray: np.ndarray) -> np.ndarray:
    """Pixels [H, W] bool whose window has a standard deviation above `TEXTURE_MIN`: only there a match means much."""
    cv2 = opencv("the filter of geometric depth")
    size = (TEXTURE_WINDOW, TEXTURE_WINDOW)
    values = gray.astype(np.float32) / 255
    mean = cv2.blur(values, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.blur(values * values, size, borderType=cv2.BORDER_REPLICATE)
    return np.sqrt(np.maximum(square - mean * mean, 0)) > TEXTURE_MIN


def surface_coherence(gray: np.ndarray, depth: np.ndarray, tolerance: float = RELATIVE_DEPTH) -> np.ndarray:
    """Share of a pixel's neighbours that lie on its tangent plane, weighted by similarity of grey value.

    A wrong match is seldom wrong in the same way as its neighbours, while a right one shares a tangent plane with them.
    The test needs nothing but the depth map, so it judges every matcher alike. A plane in space is linear in inverse
    depth over the image, so the tangent is the gradient of inverse depth, taken as a median of 5x5 that a few wrong
    neighbours cannot turn. A neighbour agrees within `tolerance` of inverse depth; those without depth count as
    disagreeing.

    Args:
        gray: uint8 [H, W].
        depth: planar z float32 [H, W], 0 where there is none.
        tolerance: share of the inverse depth.

    Returns:
        float32 [H, W] in 0..1; 0 where there is no depth.
    """
    cv2 = opencv("the filter of geometric depth")
    depth = np.ascontiguousarray(depth, np.float32)
    inverse, across, down, share = (np.empty_like(depth) for _ in range(4))
    # The flatter one-sided difference: at a depth edge the other side runs over it; a side without depth has no say.
    kernel.run("slopes", {"depth": depth, "inverse": inverse, "slope_x": across, "slope_y": down}, reach=SLOPE_REACH)
    maps = {"slope_x": cv2.medianBlur(across, 5), "slope_y": cv2.medianBlur(down, 5), "share": share}
    # By difference of grey values; the last weight, 0, is that of a pixel outside.
    weights = np.append(np.exp(-0.5 * (np.arange(256) / 255 / CONTRAST) ** 2), 0).astype(np.float32)
    maps |= {"gray": np.ascontiguousarray(gray), "inverse": inverse, "weights": weights}
    kernel.run("coherence", maps, radius=REACH, stride=STRIDE, relative=tolerance)
    return share


def remove_speckles(depth: np.ndarray, tolerance: float = RELATIVE_DEPTH) -> np.ndarray:
    """Drop connected pieces of fewer than `SPECKLE_SIZE` pixels; neighbours belong together below 2 `tolerance`.

    Works on log-depth in steps, because depth itself has no common scale across a scene.
    """
    if not np.any(depth > 0):
        return depth.astype(np.float32)
    cv2 = opencv("the filter of geometric depth")
    valid = depth > 0
    logs = np.log(np.fmax(depth, 0) * valid + ~valid, dtype=np.float32)
    scaled = (logs - (logs + NEVER * ~valid).min()) / tolerance * 4
    steps = ((np.clip(scaled, 0, 32000) + 1) * valid).astype(np.int16)
    cv2.filterSpeckles(steps, 0, SPECKLE_SIZE, 8)
    return np.where(steps > 0, depth, 0).astype(np.float32)

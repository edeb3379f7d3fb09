"""Geometric depth of one timestamp: match at three sizes, filter each, bring back to full size.

What is small, an arm or what is far away, is lost in the windows of matching and of the filter, of eleven and nineteen
pixels: so images are matched at twice the size first. A wall with little texture says nothing in such a window, and
more at half the size. What is left empty at one size is filled with what passes the same filter at the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat

import numpy as np

from d2_plugin.priors.geometry import scaled_camera
from d2_plugin.priors.stereo.filtering.confirm import RELATIVE_DEPTH
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth, filter_depths
from d2_plugin.priors.stereo.patchmatch import patchmatch
from d2_plugin.priors.stereo.reuse import MARGIN, MatchMemory, widened
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601, as every codec of the recordings uses

SCALES = (0.5, 1, 2)
"""Images are matched at this many times fewer pixels each way in turn; a later one fills what the earlier leave empty.
At a quarter of the size edges fatten; three times the size finds a little more of what moves in twice the time."""


def geometric_depth(
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
    memories: Sequence[MatchMemory] | None = None,
) -> list[GeometricDepth]:
    """D^g of every view from the synchronized views of one timestamp, and of no other.

    Args:
        images: RGB uint8 [H, W, 3] per camera.
        cameras: at least two, in the same order.
        depth_range: near and far in world units; ten times too wide does no harm.
        memories: by scale, matches of the frames before, which are carried over where the images did not change, and
            which this frame's are added to.

    Returns:
        Per camera the filtered depth; empty everywhere where nothing can be known (no texture, one centre).
    """
    grays = [gray(image) for image in images]
    by_scale = []
    for scale, memory in zip(SCALES, memories or repeat(None)):
        resized = [_resized(*view, settings.max_pixels, scale) for view in zip(grays, cameras)]
        small, small_cameras = zip(*resized)
        tolerance = RELATIVE_DEPTH * max(scale, 1)
        filtered = _matched(small, small_cameras, depth_range, settings, memory, tolerance)
        by_scale.append(
            [resampled(one, camera.width, camera.height, tolerance) for one, camera in zip(filtered, cameras)]
        )
    return [_filled(results) for results in zip(*by_scale)]


def _matched(
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
    memory: MatchMemory | None,
    tolerance: float,
) -> list[GeometricDepth]:
    """Filtered depth at one size; what did not change since the frame before is not matched again."""
    wanted = None if memory is None else memory.wanted(grays)
    matched = None if wanted is None else [widened(mask, MARGIN) for mask in wanted]
    raw = patchmatch(grays, cameras, depth_range, settings, matched)
    if memory is not None:
        raw = memory.merge(grays, raw, wanted)
    depths, costs = zip(*raw)
    return filter_depths(grays, cameras, depths, costs, settings, tolerance)


def _filled(results: Sequence[GeometricDepth]) -> GeometricDepth:
    """The first of several results of one view, with what the later ones know where it is empty."""
    depth, sigma, unconfirmed = (map_.copy() for map_ in (results[0].depth, results[0].sigma, results[0].unconfirmed))
    for coarser in results[1:]:
        empty = depth == 0
        depth[empty], sigma[empty] = coarser.depth[empty], coarser.sigma[empty]
        unconfirmed = np.where(unconfirmed > 0, unconfirmed, coarser.unconfirmed)
    survivors = results[0].record["survivors"] | {"filled": int(np.count_nonzero(depth))}
    return GeometricDepth(depth, sigma, unconfirmed * (depth == 0), {"survivors": survivors})


def gray(image: np.ndarray) -> np.ndarray:
    """Luma uint8 [H, W] of an RGB uint8 image [H, W, 3]."""
    return np.rint(image.astype(np.float32) @ LUMA).astype(np.uint8)


def _resized(gray: np.ndarray, camera: Camera, max_pixels: int, scale: float) -> tuple[np.ndarray, Camera]:
    """Image and camera at the largest of full, half, a third, ... of the size that has at most `max_pixels`, and
    `scale` times smaller."""
    divisor = scale * math.ceil(math.sqrt(gray.size / max(max_pixels, 1)))
    if divisor == 1:
        return gray, camera
    cv2 = opencv("matching at another resolution")
    width, height = max(1, round(camera.width / divisor)), max(1, round(camera.height / divisor))
    resized = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA if divisor > 1 else cv2.INTER_CUBIC)
    return resized, scaled_camera(camera, width, height)


def resampled(result: GeometricDepth, width: int, height: int, tolerance: float = RELATIVE_DEPTH) -> GeometricDepth:
    """The maps at another size: inverse depth, which is linear over a plane, is interpolated between four neighbours.

    Where they differ by more than twice `tolerance`, or one is missing, nothing is known: an interpolated value would
    hang between two surfaces. Sigma of maps that are larger grows by how many times as wide they are: a match is no
    more exact, in pixels of the image, for pixels that were made of it.
    """
    if result.depth.shape == (height, width):
        return result
    rows, row_share = _neighbours(result.depth.shape[0], height)
    columns, column_share = _neighbours(result.depth.shape[1], width)

    def interpolated(depth: np.ndarray) -> np.ndarray:
        corners = [depth[r][:, c] for r in rows for c in columns]
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = [1 / corner for corner in corners]
            top = inverse[0] * (1 - column_share) + inverse[1] * column_share
            bottom = inverse[2] * (1 - column_share) + inverse[3] * column_share
            between = 1 / (top * (1 - row_share)[:, None] + bottom * row_share[:, None])
        nearest, farthest = np.minimum.reduce(corners), np.maximum.reduce(corners)
        smooth = (nearest > 0) & (farthest - nearest <= 2 * tolerance * nearest)
        return np.where(smooth, between, 0).astype(np.float32)

    row, column = np.where(row_share < 0.5, rows[0], rows[1]), np.where(column_share < 0.5, columns[0], columns[1])
    depth = interpolated(result.depth)
    made = np.float32(max(result.depth.shape[1] / width, 1))
    sigma = np.where(depth > 0, made * result.sigma[row][:, column], np.float32(np.inf))
    return replace(result, depth=depth, sigma=sigma, unconfirmed=interpolated(result.unconfirmed))


def _neighbours(small: int, large: int) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Indices of the pixels before and after each enlarged pixel's centre, and the share of the one after."""
    position = (np.arange(large) + 0.5) * (small / large) - 0.5
    before = np.clip(np.floor(position), 0, small - 1).astype(np.int64)
    after = np.clip(before + 1, 0, small - 1)
    share = np.clip(position - before, 0, 1).astype(np.float32)
    return (before, after), share

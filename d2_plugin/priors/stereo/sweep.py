"""Guided plane sweep on the CPU with OpenCV's kernels: geometric depth where there is no compiler.

For each inverse depth one homography warps every source onto the reference, a small window correlates, the source that
matches best is taken (the others may be occluded, or too oblique), and a guided filter aggregates the cost along the
edges of the image. The minimum over planes is refined by a parabola. Planes stand a source pixel apart, which makes
the result insensitive to the range; only the running minimum and its two neighbours are kept in memory.

Fronto-parallel planes see little of a wide rig. Measured on studio (16 to 33 degrees between neighbours): completeness
is .10, where a compiled PatchMatch finds .41. With the mean of the best two sources instead of the best one it is a
third less.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType

import numpy as np

from d2_plugin.errors import missing_extra
from d2_plugin.priors.extras import opencv
from d2_plugin.priors.geometry import ViewPair, check_depth_range, cropped_camera, inverse_depth_planes, view_pair
from d2_plugin.priors.stereo.reuse import Box, covering_boxes
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

WORST_COST = 2.0
MIN_VARIANCE = 1e-5  # of grey values in 0..1 over one window: below it NCC correlates sensor noise


def sweep(
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
    wanted: Sequence[np.ndarray] | None = None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and matching cost of every view from all the others.

    Args:
        grays: uint8 [H, W] per camera.
        cameras: at least two.
        depth_range: near and far in world units.
        settings: the `sweep_*` fields are used.
        wanted: bool [H, W] per camera, pixels whose depth is asked for; all of them where None. Boxes around them are
            matched, and what lies outside of the boxes has no depth.

    Returns:
        Per camera: planar depth float32 [H, W] (0 where no source covers the pixel) and 1 - NCC float32 [H, W].
    """
    cv2 = opencv("the plane sweep")
    if not hasattr(cv2, "ximgproc"):
        raise missing_extra("OpenCV with its contrib modules", "stereo", "the plane sweep")
    depth_range = check_depth_range(depth_range)
    results = []
    for index, gray in enumerate(grays):
        depth, cost = np.zeros(gray.shape, np.float32), np.full(gray.shape, WORST_COST, np.float32)
        whole = [(slice(0, gray.shape[0]), slice(0, gray.shape[1]))]
        for box in whole if wanted is None else covering_boxes(wanted[index], _reach(settings)):
            depth[box], cost[box] = _sweep_box(cv2, index, box, grays, cameras, depth_range, settings)
        results.append((depth, cost))
    return results


def _reach(settings: StereoSettings) -> int:
    """How far away a pixel's aggregated cost asks, pixels: a guided filter is two boxes, one after the other."""
    return settings.sweep_window // 2 + 2 * settings.sweep_guide_radius


def _sweep_box(
    cv2: ModuleType,
    index: int,
    box: Box,
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and cost of one part of view `index`, whose sources are the other views in full."""
    others = [other for other in range(len(cameras)) if other != index]
    gray, camera = np.ascontiguousarray(grays[index][box]), cropped_camera(cameras[index], *box)
    planes = inverse_depth_planes(cameras[index], [cameras[j] for j in others], depth_range, settings.sweep_step)
    correlate = _correlator(cv2, gray, settings.sweep_window)
    sources = [(view_pair(camera, cameras[other]), grays[other].astype(np.float32) / 255) for other in others]
    guide = cv2.ximgproc.createGuidedFilter(
        gray, settings.sweep_guide_radius, (settings.sweep_guide_epsilon * 255) ** 2
    )
    minimum = RunningMinimum(gray.shape)
    for plane in planes:
        costs = [correlate(_warp(cv2, source, pair, plane, gray.shape)) for pair, source in sources]
        minimum.add(guide.filter(np.minimum.reduce(costs)))
    position, cost = minimum.result()
    inverse = np.interp(position, np.arange(len(planes)), planes)
    covered = cost < WORST_COST
    return np.where(covered, 1 / inverse, 0).astype(np.float32), np.where(covered, cost, WORST_COST)


def _warp(cv2: ModuleType, gray: np.ndarray, pair: ViewPair, plane: float, shape: tuple[int, int]) -> np.ndarray:
    """The source seen from the reference through the plane at inverse depth `plane`; -1 outside of the source."""
    homography = pair.A.copy()
    homography[:, 2] += pair.k * plane
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(
        gray, homography, shape[::-1], flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1
    )


def _correlator(cv2: ModuleType, gray: np.ndarray, window: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function from a warped source to 1 - NCC with the reference, whose own moments are computed once."""

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, (window, window), borderType=cv2.BORDER_REPLICATE)

    reference = gray.astype(np.float32) / 255
    mean_r = mean(reference)
    variance_r = mean(reference * reference) - mean_r * mean_r

    def cost(warped: np.ndarray) -> np.ndarray:
        outside = warped < 0
        warped[outside] = 0
        mean_w = mean(warped)
        variance_w = mean(warped * warped) - mean_w * mean_w
        covariance = mean(warped * reference) - mean_w * mean_r
        product = np.maximum(variance_w, 0) * np.maximum(variance_r, 0)
        result = 1 - covariance / np.sqrt(np.maximum(product, MIN_VARIANCE**2))
        result[outside | (variance_w < MIN_VARIANCE) | (variance_r < MIN_VARIANCE)] = WORST_COST
        return result

    return cost


class RunningMinimum:
    """Minimum over a stream of cost slices, with both neighbours of the best slice for a parabola; O(1) memory."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._count = 0
        self._previous = np.full(shape, np.inf, np.float32)
        self._best = np.full(shape, np.inf, np.float32)
        self._before = np.full(shape, np.inf, np.float32)
        self._after = np.full(shape, np.inf, np.float32)
        self._index = np.zeros(shape, np.int32)

    def add(self, cost: np.ndarray) -> None:
        """The next slice, float32 [H, W]."""
        was_best = self._index == self._count - 1
        np.copyto(self._after, cost, where=was_best)
        better = cost < self._best
        np.copyto(self._best, cost, where=better)
        np.copyto(self._before, self._previous, where=better)
        self._after[better] = np.inf
        self._index[better] = self._count
        self._previous = cost
        self._count += 1

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Position of the minimum in slices (fractional; float64) and its cost; a minimum at either end stays there."""
        inner = np.isfinite(self._before) & np.isfinite(self._after)
        before, after = np.where(inner, self._before, self._best), np.where(inner, self._after, self._best)
        curvature = before - 2 * self._best + after
        offset = np.where(curvature > 1e-6, 0.5 * (before - after) / np.maximum(curvature, 1e-6), 0)
        return self._index + np.clip(offset, -0.5, 0.5).astype(np.float64), self._best

"""An image and its planes from coarse to fine: each resolution twice the one before, planes carried over exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from d2_plugin.priors.geometry import pixel_grid, scaled_camera
from d2_plugin.recordings.recording import Camera

NO_MATCH = 2.0
"""Worst matching cost; such a pixel has no depth."""

SMALLEST_SIDE = 12
"""No view is made so small that its shorter side has fewer pixels than this: an 11-pixel window must fit."""


@dataclass(eq=False)
class LevelView:
    """One camera at one resolution, with the planes so far."""

    camera: Camera
    gray: np.ndarray  # uint8 [H, W]
    quads: np.ndarray  # uint32 [H, W]
    planes: np.ndarray  # float32 [H, W, 3]
    known: np.ndarray  # bool [H, W], whether anything matched here, at this or a coarser resolution
    cost: np.ndarray  # float32 [H, W]
    wanted: np.ndarray | None  # bool [H, W], pixels to match; everywhere where None


def levels(cameras: Sequence[Camera], rounds: Sequence[int]) -> list[tuple[int, int]]:
    """(divisor of the resolution, rounds) from coarse to fine, without levels too small for every view."""
    side = max(min(camera.width, camera.height) for camera in cameras)
    steps = [(2 ** (len(rounds) - 1 - number), count) for number, count in enumerate(rounds)]
    return [(divisor, count) for divisor, count in steps if divisor == 1 or side // divisor >= SMALLEST_SIDE]


def at_resolution(
    gray: np.ndarray, camera: Camera, coarser: LevelView | None, wanted: np.ndarray | None, divisor: int
) -> LevelView:
    """The view `divisor` times smaller each way, or as small as may be, with the planes of the coarser one if any."""
    while divisor > 1 and min(camera.width, camera.height) // divisor < SMALLEST_SIDE:
        divisor //= 2
    if divisor > 1:
        camera = scaled_camera(camera, round(camera.width / divisor), round(camera.height / divisor))
        gray = shrunk(gray, (camera.height, camera.width))
    gray = np.ascontiguousarray(gray)
    cost = np.full(gray.shape, NO_MATCH, np.float32)
    if coarser is None:
        planes, known = np.zeros((*gray.shape, 3), np.float32), np.zeros(gray.shape, bool)
    else:
        planes, known = refined_planes(coarser.planes, gray.shape), _nearest(coarser.known, gray.shape)
    mask = None if wanted is None else _any_within(wanted, gray.shape)
    return LevelView(camera, gray, _quads(gray), planes, known, cost, mask)


def shrunk(gray: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A grey image uint8 at a smaller size: each pixel is the mean of those that it touches, rounded half to even."""
    sums, rows = _sums(gray, shape[0])
    sums, columns = _sums(sums.T, shape[1])
    return np.rint(sums.T / rows[:, None] / columns).astype(np.uint8)


def _sums(values: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Per row of an image with `size` rows the sum of those that it touches, and float32 how many there are."""
    number = np.arange(size)
    first, end = number * len(values) // size, -(-(number + 1) * len(values) // size)
    step = len(values) // size
    sums = np.zeros((size, values.shape[1]), np.float32)  # exact below 2^24, as all sums of grey values here are
    for offset in range((end - first).max()):
        if step * size == len(values):
            sums += values[offset::step]
        else:
            touched = first + offset < end
            sums[touched] += values[(first + offset)[touched]]
    return sums, (end - first).astype(np.float32)


def _any_within(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Coarse pixels of `shape` from which any pixel of a finer mask takes its plane, bool."""
    if mask.shape == shape:
        return np.ascontiguousarray(mask)
    rows, columns = _parents(shape, mask.shape)
    y, x = np.nonzero(mask)
    coarse = np.zeros(shape, bool)
    coarse[rows[y], columns[x]] = True
    return coarse


def refined_planes(planes: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Planes [h, w, 3] of a coarse image as planes [H, W, 3] of a finer one: the same planes in space, exactly.

    The centre of fine pixel u is at s (u + 1/2) - 1/2 in coarse indices, s = w / W, so a u' + b v' + c stays linear.
    """
    scale_v, scale_u = (coarse / fine for coarse, fine in zip(planes.shape[:2], shape))
    a, b, c = np.moveaxis(planes, -1, 0)
    scaled = np.empty(planes.shape, np.float32)
    scaled[..., 0], scaled[..., 1] = a * scale_u, b * scale_v
    scaled[..., 2] = c + a * (scale_u - 1) / 2 + b * (scale_v - 1) / 2
    return _nearest(scaled, shape)


def _nearest(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """`values` [h, w, ...] at [H, W], each fine pixel taking what the coarse pixel around its centre has."""
    rows, columns = _parents(values.shape[:2], shape)
    return values.take(columns, axis=1).take(rows, axis=0)  # whole rows last


def _parents(coarse: tuple[int, int], fine: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the coarse pixel around the centre of each fine row and column."""
    rows, columns = (((np.arange(to) + 0.5) * (of / to)).astype(np.int64) for of, to in zip(coarse, fine))
    return rows, columns


def plane_depth(view: LevelView) -> np.ndarray:
    """Planar depth float32 [H, W] of the planes; 0 where nothing matched.

    Where only a coarser window had texture the depth is kept, with the worst cost: the filter refuses it as an anchor,
    yet it tells where the surface runs.
    """
    u, v = pixel_grid(view.camera)
    inverse = view.planes[..., 0] * u + view.planes[..., 1] * v + view.planes[..., 2]
    known = view.known & (inverse > 0)
    return np.where(known, 1 / np.where(known, inverse, 1), 0).astype(np.float32)


def _quads(gray: np.ndarray) -> np.ndarray:
    """Per pixel the grey values of itself, its right, lower and lower right neighbour, in one uint32 [H, W].

    A bilinear sample then costs one gather instead of four.
    """
    padded = np.pad(gray, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    upper, lower = padded[:-1], padded[1:]
    return upper[:, :-1] | upper[:, 1:] << 8 | lower[:, :-1] << 16 | lower[:, 1:] << 24

"""Local correction of aligned monocular depth by the geometric depths around it; an addition to the paper.

One scale and one shift per image cannot undo what a network bends: walls, people and tables are each off by their own
few per cent. The logarithm of D^g / D-bar^m at the anchors shows that bend. It is averaged robustly over windows from
coarse to fine, each correcting what the coarser ones left, and fades to none where no anchor is near. An anchor that
disagrees with the many around it is outvoted there, so verification by the corrected map is sharper, not weaker.
"""

from __future__ import annotations

import functools
from types import ModuleType

import numpy as np

from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.recordings.images import opencv

SCALES = (0.25, 0.12, 0.06, 0.03)
"""Standard deviations of the windows, coarse to fine, image widths."""
PRIOR = 0.05
"""Weight of "no correction": a window in which this share of the pixels is known is corrected by half."""
LIMIT = 0.7
"""Anchors off by more than this in log depth (a factor of two) say nothing about the bend of the map."""
GRID = 80  # cells across the image
OUTLIER = 0.03  # of log depth: an anchor this far from the average of its window has 0.7 of its weight
ROUNDS = 2  # of reweighting


def corrected_depth(aligned: np.ndarray, geometric: np.ndarray, settings: AlignSettings) -> np.ndarray:
    """Aligned monocular depth times its local correction, float32 [H, W]; 0 stays 0.

    Args:
        aligned: D-bar^m [H, W], 0 where it has none.
        geometric: D^g [H, W], 0 where there is none.
        settings: without `local_correction` the map comes back as it is, which is the paper.
    """
    return corrected_without(aligned, geometric, np.zeros((1, 1, 1), bool), settings)[0]


def corrected_without(
    aligned: np.ndarray, geometric: np.ndarray, left_out: np.ndarray, settings: AlignSettings
) -> np.ndarray:
    """`corrected_depth` once for each of several choices of anchors, float32 [n, H, W].

    Args:
        left_out: anchors that do not count, bool [n, H, W].
    """
    known = (aligned > 0) & (geometric > 0)
    if not settings.local_correction or not known.any():
        return np.repeat(aligned[None].astype(np.float32), len(left_out), axis=0)
    with np.errstate(all="ignore"):  # where either is 0 the ratio is no number, which no limit admits
        bend = np.divide(geometric, aligned)
        bend = np.log(bend, out=bend).astype(np.float32, copy=False)
        known &= np.abs(bend) < LIMIT
    some = known[None] if left_out.size == 1 and not left_out.any() else known & ~left_out
    fields = _smooth_fields(bend, some)
    np.exp(fields, out=fields)
    return np.multiply(aligned, fields, out=fields) if aligned.dtype == np.float32 else (aligned * fields).astype("f4")


def _smooth_fields(bend: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Corrections of log depth [n, H, W] from its values [H, W] at the known pixels [n, H, W]."""
    cv2 = opencv("the local correction")
    height, width = bend.shape
    cell = max(1, round(width / GRID))
    rows, columns = -(-height // cell), -(-width // cell)
    blurs = []
    for scale in SCALES:
        sigma = max(scale * width / cell, 0.5)
        blurs.append((_blur_matrix(cv2, rows, sigma), _blur_matrix(cv2, columns, sigma)))
    count = _block_sum(known, cell)
    mean = _block_sum(np.where(known, bend, np.float32(0)), cell) / np.maximum(count, 1)
    share, cells = count / np.float32(cell**2), np.zeros_like(mean)
    for down, across in blurs:
        cells += _robust_average(down, across, mean - cells, share)
    fields = np.empty(known.shape, np.float32)
    for field, out in zip(cells, fields):
        enlarged = cv2.resize(field, (columns * cell, rows * cell), interpolation=cv2.INTER_LINEAR)
        out[:] = enlarged[:height, :width]
    return fields


def _robust_average(down: np.ndarray, across: np.ndarray, values: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Gaussian averages [n, rows, columns] weighted by how much of a cell is known, then by agreement with the average.

    Args:
        down, across: blur of a column and of a row of cells.
        values: of the cells [n, rows, columns].
        share: how much of each cell is known, 0..1.
    """

    def average(weight: np.ndarray) -> np.ndarray:
        # One product for each map: larger ones BLAS would split over threads, which wait long on a busy machine.
        blurred = down @ np.concatenate([weight * values, weight]) @ across.T
        total, weights = blurred[: len(values)], blurred[len(values) :]
        return total / (weights + np.float32(PRIOR))

    weight = share
    for _ in range(ROUNDS):
        weight = share * np.float32(OUTLIER) / np.sqrt((values - average(weight)) ** 2 + np.float32(OUTLIER**2))
    return average(weight)


@functools.cache
def _blur_matrix(cv2: ModuleType, size: int, sigma: float) -> np.ndarray:
    """Gaussian blur of a row of `size` cells with nothing beyond its ends, float32 [size, size].

    A product of matrices is faster for so few cells; the numbers are OpenCV's own.
    """
    reach = round(4 * sigma)  # beyond it a Gaussian is taken for zero
    window = cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_32F).ravel()
    places = np.arange(size)[:, None] - np.arange(size) + reach
    inside = (places >= 0) & (places < window.size)
    return np.where(inside, window[np.clip(places, 0, window.size - 1)], 0).astype(np.float32)


def _block_sum(values: np.ndarray, cell: int) -> np.ndarray:
    """Sums [n, rows, columns] over cells of `cell` pixels a side; those at the lower and right rim may be cut."""
    count, height, width = values.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((count, rows * cell, columns * cell), np.float32)
    padded[:, :height, :width] = values
    return padded.reshape(count, rows, cell, columns, cell).sum(axis=(2, 4))

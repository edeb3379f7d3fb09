"""Sweeps over the alignment of depth priors: wrong anchors, vanishing smoothing, ranges of depth.

The fit always computes in float64; what is swept in float32 is the precision in which the maps are given.
"""

import numpy as np
import torch

from benchmarks.stability.definition import decades, sweep
from d2_plugin.errors import D2Error
from d2_plugin.priors.monocular.affine import fit_affine
from d2_plugin.priors.monocular.align import AlignStatus, align
from d2_plugin.priors.settings import AlignSettings

SCALE, SHIFT = 2.0, 0.5
ANCHORS = 20_000


def maps(dtype: torch.dtype, outliers: float = 0.0, unit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A monocular map with noise of 1 % and the depth [n] it belongs to, as numbers of a precision."""
    rng = np.random.default_rng(0)
    y = rng.uniform(1, 6, ANCHORS)
    x = (y - SHIFT) / SCALE + rng.normal(0, 0.005, ANCHORS)
    wrong = rng.choice(ANCHORS, int(outliers * ANCHORS), replace=False)
    y[wrong] = rng.uniform(0.5, 12, len(wrong))
    kind = np.float32 if dtype == torch.float32 else np.float64
    return x.astype(kind), (y * unit).astype(kind)


def aligned_scale(x: np.ndarray, y: np.ndarray) -> float:
    """The scale of a metric map.

    Raises:
        D2Error: the alignment was refused.
    """
    found = align(x[None], y[None], kind="metric", settings=AlignSettings())
    if found.status is not AlignStatus.OK:
        raise D2Error(f"alignment: {found.status.value}")
    return found.scale


@sweep(
    *("share of wrong anchors", tuple(round(0.05 * i, 2) for i in range(13)), "relative error of the scale"),
    "a fit with fewer than 30 % inliers, or that the ranks contradict, is refused with a status",
    {"float32": 0.05, "float64": 0.05},
)
def outliers(share: float, dtype: torch.dtype) -> float:
    """Relative error of the scale with a share of uniform wrong depths."""
    return abs(aligned_scale(*maps(dtype, share)) / SCALE - 1)


@sweep(
    *("smoothing over median depth", decades(-8, -1), "certified relative duality gap"),
    *("epsilon is at least 1e-100 in normalised units", {"float32": 1e-9, "float64": 1e-9}),
)
def epsilon(share: float, dtype: torch.dtype) -> float:
    """Certified relative duality gap with 45 % outliers; epsilon is this share of the median depth."""
    x, y = maps(dtype, 0.45)
    return fit_affine(x, y, epsilon=share * float(np.median(y))).gap


@sweep(
    *("unit of depth", decades(-3, 6), "relative error of the scale"),
    *("nothing: data are centred and scaled before the fit", {"float32": 1e-3, "float64": 1e-3}),
)
def unit_of_depth(unit: float, dtype: torch.dtype) -> float:
    """Relative error of the scale when depth is measured in another unit."""
    return abs(aligned_scale(*maps(dtype, unit=unit)) / (SCALE * unit) - 1)


PRIORS = (outliers, epsilon, unit_of_depth)
"""The sweeps of this file."""

"""Raw parameters of Gaussians to slice, for the tests of the slice in torch and in the kernel."""

import math

import torch
from torch import Tensor

from d2_plugin.gaussians.native_slice import STATIC, TEMPORAL
from d2_plugin.gaussians.slicing import LOG_SCALE_LIMIT, MARGINAL_CUT

AT, CONSTANTS = 0.5, (MARGINAL_CUT, LOG_SCALE_LIMIT)

# mean, mean time, scales, left, right, instant -> sliced mean, covariance, marginal, temporal variance, velocity
GOLDEN = {
    "A": (
        (1, 2, 3), 0.5, (0.1, 0.2, 0.3, 0.4), (1, 0, 0, 0), (1, 0, 0, 0), 0.7,
        (1, 2, 3), (0.01, 0, 0, 0.04, 0, 0.09), 0.8824969025845955, 0.16, (0, 0, 0),
    ),
    "B": (
        (0, 0, 2), 0.0, (0.1, 0.2, 0.3, 0.5), (1, 0.2, -0.1, 0.05), (0.9, -0.1, 0.3, 0.2), 0.4,
        (-0.07657938, -0.13313971, 2.09110397),
        (0.01544891, 0.00192817, -0.01986139, 0.04780662, 0.0069878, 0.08927245),
        0.6676256617997561, 0.19800625078134768, (-0.19144844, -0.33284928, 0.22775992),
    ),
    "C": (
        (-1, 0.5, 4), 1.0, (0.05, 0.02, 0.04, 2**0.5), (2, 0.4, 0.2, -0.6), (0.5, 0.1, 0.05, 0.15), 2.5,
        (-1.93595609, 0.68695754, 3.90645446),
        (0.00307141, -0.00098906, 0.00024459, 0.00077273, -0.00013639, 0.0016432),
        0.4525663865678813, 1.4189839335180057, None,
    ),
}  # fmt: skip


def random_rows(count: int, temporal: bool, seed: int = 0, time_scale: float = 0.2) -> dict[str, Tensor]:
    """Raw parameters in float32; with `time_scale` 0.2 about two in three are drawn at AT."""
    generator = torch.Generator().manual_seed(seed)
    rows = {
        name: torch.randn(*((count, width) if width > 1 else (count,)), generator=generator)
        for name, width in (TEMPORAL if temporal else STATIC).items()
    }
    rows["log_scales"] = rows["log_scales"] * 0.7 - 2
    if temporal:
        rows["times"] = rows["times"] * 0.5 + AT
        rows["log_time_scales"] = rows["log_time_scales"] * 0.3 + math.log(time_scale)
    return rows


def relative_error(value: Tensor, expected: Tensor) -> float:
    difference = torch.linalg.vector_norm(value.double() - expected)
    return float(difference / torch.linalg.vector_norm(expected).clamp(min=1e-300))

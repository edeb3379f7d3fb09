"""Rows of Gaussians for tests of slicing, and the distance of what comes out."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from d2_plugin.gaussians.native_slice import STATIC, TEMPORAL
from d2_plugin.gaussians.slicing import LOG_SCALE_LIMIT, MARGINAL_CUT

AT, CONSTANTS = 0.5, (MARGINAL_CUT, LOG_SCALE_LIMIT)


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
    """Relative L2 distance."""
    difference = torch.linalg.vector_norm(value.double() - expected)
    return float(difference / torch.linalg.vector_norm(expected).clamp(min=1e-300))

"""Nearest neighbours of points."""

from __future__ import annotations

import torch
from torch import Tensor

PAIRS = 1 << 22
"""Distances held in memory at a time."""


def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Distances and indices [M, k] of the k <= N points [N, D] nearest to each query [M, D], the nearest first.

    From differences: `cdist` by itself multiplies matrices, and far from the origin loses what lies close together.
    """
    exact = "donot_use_mm_for_euclid_dist"
    parts = queries.split(max(PAIRS // max(len(points), 1), 1))
    each = [torch.cdist(part, points, compute_mode=exact).topk(k, largest=False) for part in parts]
    distances, indices = (torch.cat(values) for values in zip(*each))
    return distances, indices

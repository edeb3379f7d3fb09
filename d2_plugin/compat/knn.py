"""`mmcv.ops.knn`, which SpacetimeGaussians imports for the spacing of its initial points."""

from __future__ import annotations

import torch
from torch import Tensor

PAIRS = 1 << 24
"""Distances held in memory at a time."""


def knn(k: int, xyz: Tensor, center_xyz: Tensor | None = None, transposed: bool = False) -> Tensor:
    """Indices [B, k, M] int32 of the k points of `xyz` [B, N, 3] nearest to each of `center_xyz` [B, M, 3].

    A point that is its own centre is its own nearest one, as in the original. `transposed` says [B, 3, N].
    """
    centers = xyz if center_xyz is None else center_xyz
    if transposed:
        xyz, centers = xyz.transpose(1, 2), centers.transpose(1, 2)
    rows = max(PAIRS // max(xyz.shape[1], 1), 1)
    parts = [torch.cdist(part, xyz).topk(k, largest=False).indices for part in centers.split(rows, dim=1)]
    return torch.cat(parts, 1).transpose(1, 2).contiguous().int()

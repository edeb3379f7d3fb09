"""What cem-4dgs calls of pytorch3d and of faiss on a GPU: products of quaternions, and the nearest neighbour.

Quaternions [..., 4] have w first. As in pytorch3d nothing is normalised here, and a product has w >= 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

PAIRS = 1 << 24
"""Distances held in memory at a time."""


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """The rotation b and then a, with w >= 0."""
    product = _product(a, b)
    return torch.where(product[..., :1] < 0, -product, product)


def quaternion_invert(quaternion: Tensor) -> Tensor:
    """The conjugate: the inverse of a unit quaternion."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def quaternion_apply(quaternion: Tensor, point: Tensor) -> Tensor:
    """Points [..., 3], turned by q p q*; a quaternion that is not of unit length scales them by its square."""
    pure = torch.cat([torch.zeros_like(point[..., :1]), point], -1)
    return _product(_product(quaternion, pure), quaternion_invert(quaternion))[..., 1:]


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    crossed = torch.linalg.cross(*torch.broadcast_tensors(a[..., 1:], b[..., 1:]))
    return torch.cat([scalar, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + crossed], -1)


class StandardGpuResources:
    """There are none to hold."""


class GpuIndexFlatL2:
    """An exact index of points by squared distance."""

    def __init__(self, resources: Any, size: int) -> None:
        self._points = torch.empty(0, size)

    def add(self, points: np.ndarray) -> None:
        """Points [N, size] float32 after those that are there."""
        self._points = torch.cat([self._points, torch.from_numpy(np.ascontiguousarray(points))])

    def search(self, queries: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Squared distances [M, k] float32 and indices [M, k] int64 of the k nearest points, the nearest first."""
        asked = torch.from_numpy(np.ascontiguousarray(queries))
        parts = asked.split(max(PAIRS // max(len(self._points), 1), 1))
        exact = "donot_use_mm_for_euclid_dist"
        found = [torch.cdist(part, self._points, compute_mode=exact).topk(k, largest=False) for part in parts]
        distances, indices = (torch.cat(each) for each in zip(*found))
        return distances.square().numpy(), indices.numpy()

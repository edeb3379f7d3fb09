"""Nearest neighbours: `simple_knn._C.distCUDA2`, `mmcv.ops.knn`, and what cem-4dgs calls of faiss."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.nearest import nearest

NEIGHBOURS = 3


def distCUDA2(points: Tensor) -> Tensor:
    """Mean of the squared distances to the three nearest other points, [N] float32; exact, on any device.

    Args:
        points: [N, 3]. With fewer than four points the mean goes over those that exist; 0 for a single point.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise D2Error(f"points have shape {tuple(points.shape)}, expected [N, 3]: pass positions in the world")
    if len(points) < 2:
        return torch.zeros(len(points), device=points.device)
    points = points.detach().double()
    distances, _ = nearest(points, points, min(NEIGHBOURS, len(points) - 1) + 1)
    return distances[:, 1:].square().mean(1).float()


def knn(k: int, xyz: Tensor, center_xyz: Tensor | None = None, transposed: bool = False) -> Tensor:
    """As mmcv's: indices [B, k, M] int32 of the k points of `xyz` [B, N, 3] nearest to each of `center_xyz` [B, M, 3].

    A point that is its own centre is its own nearest one, as in the original. `transposed` says [B, 3, N].
    """
    centers = xyz if center_xyz is None else center_xyz
    if transposed:
        xyz, centers = xyz.transpose(1, 2), centers.transpose(1, 2)
    pairs = [nearest(points, queries, k)[1] for points, queries in zip(xyz, centers)]
    return torch.stack(pairs).transpose(1, 2).contiguous().int()


class StandardGpuResources:
    """faiss's; there are none to hold."""


class GpuIndexFlatL2:
    """faiss's exact index of points by squared distance."""

    def __init__(self, resources: Any, size: int) -> None:
        self._points = torch.empty(0, size)

    def add(self, points: np.ndarray) -> None:
        """Points [N, size] float32 after those that are there."""
        self._points = torch.cat([self._points, torch.from_numpy(np.ascontiguousarray(points))])

    def search(self, queries: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Squared distances [M, k] float32 and indices [M, k] int64 of the k nearest points, the nearest first."""
        distances, indices = nearest(self._points, torch.from_numpy(np.ascontiguousarray(queries)), k)
        return distances.square().numpy(), indices.numpy()

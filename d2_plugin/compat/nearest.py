"""Nearest neighbours: `simple_knn._C.distCUDA2`, `mmcv.ops.knn`, and what cem-4dgs calls of faiss."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error

NEIGHBOURS = 3

PAIRS = 1 << 22
"""Distances held in memory at a time."""

FARTHEST_CELL = 1 << 19
"""Largest number of a cell, counted from the median along each axis."""


def distCUDA2(points: Tensor) -> Tensor:
    """Mean of the squared distances to the three nearest other points, [N] float32; exact, on any device.

    Args:
        points: [N, 3]. With fewer than four points the mean goes over those that exist; 0 for a single point.

    A uniform grid finds the neighbours within one cell's side; what it leaves open is searched again with a side twice
    as long, and by comparing with all points once few are left.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise D2Error(f"points have shape {tuple(points.shape)}, expected [N, 3]: pass positions in the world")
    points = points.detach().double()
    count = len(points)
    if count < 2:
        return torch.zeros(count, device=points.device)
    neighbours = min(NEIGHBOURS, count - 1)
    squared = points.new_empty(count, neighbours)
    open_rows = torch.arange(count, device=points.device)
    side = _first_side(points)
    while len(open_rows) * count > PAIRS and side > 0:
        nearest = _within_cells(points, open_rows, side, neighbours)
        certain = nearest[:, -1] <= side * side  # whatever lies outside the 27 cells is farther away than one side
        squared[open_rows[certain]] = nearest[certain]
        open_rows, side = open_rows[~certain], 2 * side
    for rows in open_rows.split(max(PAIRS // count, 1)):
        squared[rows] = _among_all(points, rows, neighbours)
    return squared.mean(1).float()


def _first_side(points: Tensor) -> float:
    """Side of a cell that would hold two points if they lay evenly in the box of the middle nine tenths of each axis.

    Triangulated clouds have points far outside, which must not decide. 0 where that box is a point.
    """
    low, high = (points.kthvalue(max(round(part * len(points)), 1), dim=0).values for part in (0.05, 0.95))
    extent = (high - low).clamp(min=1e-3 * float((high - low).max()))
    return float((2 * extent.prod() / len(points)) ** (1 / 3))


def _among_all(points: Tensor, rows: Tensor, neighbours: int) -> Tensor:
    """Squared distances [R, neighbours] of `rows` to their nearest other points."""
    squared = (points[rows, None] - points).square().sum(-1)
    squared[torch.arange(len(rows), device=rows.device), rows] = torch.inf
    return squared.topk(neighbours, largest=False).values


def _within_cells(points: Tensor, rows: Tensor, side: float, neighbours: int) -> Tensor:
    """As `_among_all`, but looking only into the 27 cells around each point; infinity where they hold too few."""
    # Clamping keeps neighbours in neighbouring cells, and the keys of far-off points inside 64 bits.
    cells = torch.floor((points - points.median(0).values) / side).clamp(-FARTHEST_CELL, FARTHEST_CELL).long()
    width = 2 * FARTHEST_CELL + 3
    strides = torch.tensor([width * width, width, 1], device=points.device)
    keys, order = (cells * strides).sum(1).sort()
    # Runs along z: three neighbouring cells are one stretch of the sorted points, so nine searches do for 27 cells.
    steps = torch.cartesian_prod(*[torch.tensor([-1, 0, 1], device=points.device)] * 2)
    middle = (cells[rows] * strides).sum(1)[:, None] + steps @ strides[:2]
    first, last = torch.searchsorted(keys, middle - 1), torch.searchsorted(keys, middle + 1, right=True)
    nearest = points.new_full((len(rows), neighbours), torch.inf)
    for part in _parts((last - first).sum(1)):
        nearest[part] = _nearest_of_runs(points, rows[part], order, first[part], last[part], neighbours)
    return nearest


def _parts(sizes: Tensor) -> list[slice]:
    """Slices of rows with at most about PAIRS candidates together."""
    batch = torch.div(sizes.cumsum(0), PAIRS, rounding_mode="floor")
    _, lengths = batch.unique_consecutive(return_counts=True)
    ends = lengths.cumsum(0).tolist()
    return [slice(begin, end) for begin, end in zip([0, *ends], ends)]


def _nearest_of_runs(
    points: Tensor, rows: Tensor, order: Tensor, first: Tensor, last: Tensor, neighbours: int
) -> Tensor:
    """Squared distances [R, neighbours] among the points order[first:last] of nine runs [R, 9] per row."""
    lengths = (last - first).flatten()
    owner = torch.arange(len(lengths), device=rows.device).repeat_interleave(lengths)
    place = torch.arange(len(owner), device=rows.device) - (lengths.cumsum(0) - lengths)[owner]
    candidate, row = order[first.flatten()[owner] + place], owner // first.shape[1]
    squared = (points[candidate] - points[rows[row]]).square().sum(1)
    squared[candidate == rows[row]] = torch.inf
    # Sorted by distance and then, stably, by row: the first few of every row are its nearest.
    by_distance = squared.argsort()
    by_row = by_distance[row[by_distance].argsort(stable=True)]
    counts = torch.bincount(row, minlength=len(rows))
    start = counts.cumsum(0) - counts
    rank = torch.arange(neighbours, device=rows.device)
    index = (start[:, None] + rank).clamp(max=max(len(by_row) - 1, 0))
    return torch.where(rank < counts[:, None], squared[by_row[index]], torch.inf)


def knn(k: int, xyz: Tensor, center_xyz: Tensor | None = None, transposed: bool = False) -> Tensor:
    """As mmcv's: indices [B, k, M] int32 of the k points of `xyz` [B, N, 3] nearest to each of `center_xyz` [B, M, 3].

    A point that is its own centre is its own nearest one, as in the original. `transposed` says [B, 3, N].
    """
    centers = xyz if center_xyz is None else center_xyz
    if transposed:
        xyz, centers = xyz.transpose(1, 2), centers.transpose(1, 2)
    pairs = [_nearest(points, queries, k)[1] for points, queries in zip(xyz, centers)]
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
        distances, indices = _nearest(self._points, torch.from_numpy(np.ascontiguousarray(queries)), k)
        return distances.square().numpy(), indices.numpy()


def _nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Distances and indices [M, k] of the points [N, D] nearest to each query [M, D]."""
    exact = "donot_use_mm_for_euclid_dist"
    parts = queries.split(max(PAIRS // max(len(points), 1), 1))
    each = [torch.cdist(part, points, compute_mode=exact).topk(k, largest=False) for part in parts]
    distances, indices = (torch.cat(values) for values in zip(*each))
    return distances, indices

"""Nearest neighbours of points."""

from __future__ import annotations

import torch
from torch import Tensor

GROUP = 128
"""Queries that are looked at together."""


def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Distances and indices [M, k] of the k <= N points [N, D] nearest to each query [M, D], the nearest first.

    Queries are halved along their longest side until they are few. Some points nearest to their box bound how far off
    the k nearest can be; points that are farther from the box than that are left out.
    """
    if len(queries) > GROUP:
        order = queries[:, (queries.amax(0) - queries.amin(0)).argmax()].argsort()
        halves = [nearest(points, queries[half], k) for half in order.chunk(2)]
        distances, indices = (torch.cat(values)[order.argsort()] for values in zip(*halves))
        return distances, indices

    def among(some: Tensor) -> tuple[Tensor, Tensor]:
        # From differences: a product of matrices, far from the origin, loses what lies close together.
        return torch.cdist(queries, some, compute_mode="donot_use_mm_for_euclid_dist").topk(k, largest=False)

    if len(points) <= GROUP or not len(queries):
        return among(points)
    outside = (points - points.clamp(queries.amin(0), queries.amax(0))).square().sum(1).sqrt()
    bound = among(points[outside.topk(max(GROUP, k), largest=False).indices])[0].max()
    near = (~(outside > 1.0001 * bound)).nonzero()[:, 0]  # more than by rounding; where it is NaN all stay
    distances, indices = among(points[near])
    return distances, near[indices]

"""Where a Gaussian must lie in canonical space to be seen at a given place: inversion of a deformation field."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from d2_plugin.protocol import Points

DISTANCES_AT_ONCE = 1 << 24
"""Entries of the distance matrix that are held at a time (64 MiB in float32)."""

FAR = 1e18
"""Where Gaussians without a finite place are taken to be: its square is still a float."""

ACCEPTED = 0.5
"""Largest accepted residual, in standard deviations of each point: one that is off by half of its own width still
covers its pixel, whatever the unit of length."""


class Inversion(NamedTuple):
    """Canonical positions of K points, and which of them the field really maps onto their target."""

    positions: Tensor  # [K, 3]
    accepted: Tensor  # bool [K]
    residuals: Tensor  # [K] distance between target and deformed position, world units; inf where not finite


@torch.no_grad()
def invert_deformation(
    deform: Callable[[Tensor], Tensor],
    targets: Tensor,
    means: Tensor,
    offsets: Tensor,
    tolerance: Tensor | float,
    steps: int = 8,
) -> Inversion:
    """Solve x + offset(x) = target for each point by a damped fixed point that never lets a residual grow.

    Each point starts at its target minus the offset of the nearest deformed Gaussian. A step goes along the residual;
    one that does not lower it is halved and tried again from the same place, since the plain fixed point diverges
    where the field is steep (a positional encoding of ten octaves). A point whose residual stays above the tolerance
    keeps its neighbour's offset and is not accepted.

    Args:
        deform: canonical positions [K, 3] to deformed ones [K, 3]; row r always belongs to target r, so that every
            point may have its own time.
        targets: [K, 3] world.
        means: [M, 3] world, the deformed positions of the existing Gaussians; M may be 0.
        offsets: [M, 3], their deformed minus their canonical positions.
        tolerance: largest residual that is accepted, world units, one number or [K].
        steps: evaluations of the field after the first.
    """
    start = targets - neighbour_offsets(targets, means, offsets)
    best, residual = start, targets - deform(start)
    error = _length(residual)
    damping = torch.ones_like(error)
    for _ in range(steps):
        candidate = best + damping[:, None] * torch.nan_to_num(residual, nan=0.0, posinf=0.0, neginf=0.0)
        new_residual = targets - deform(candidate)
        new_error = _length(new_residual)
        better = new_error < error
        best = torch.where(better[:, None], candidate, best)
        residual = torch.where(better[:, None], new_residual, residual)
        error = torch.where(better, new_error, error)
        damping = torch.where(better, (2 * damping).clamp(max=1.0), damping / 2)
    accepted = error <= tolerance
    return Inversion(torch.where(accepted[:, None], best, start), accepted, error)


def neighbour_offsets(targets: Tensor, means: Tensor, offsets: Tensor) -> Tensor:
    """The offset [K, 3] of the Gaussian of `means` [M, 3] nearest to each target; zeros where there are none."""
    if not len(means) or not len(targets):
        return torch.zeros_like(targets)
    centre = targets.mean(0)  # the distances are differences of large squares far from the origin
    centred = torch.nan_to_num(means, FAR, FAR, -FAR) - centre  # argmin takes a NaN for the nearest
    rows = max(1, DISTANCES_AT_ONCE // len(means))
    nearest = torch.cat([torch.cdist(part, centred).argmin(1) for part in (targets - centre).split(rows)])
    return offsets[nearest]


def _length(residual: Tensor) -> Tensor:
    return torch.nan_to_num(residual.norm(dim=-1), nan=torch.inf)


@torch.no_grad()
def invert_at_times(points: Points, deformed: Callable[[Tensor, float], Tensor], present: Tensor) -> Inversion:
    """Canonical positions of points that were each seen at their own time.

    Args:
        points: K points; `times` in the field's unit.
        deformed: canonical positions [n, 3] and a time to deformed positions [n, 3].
        present: canonical positions [N, 3] of the existing Gaussians.
    """
    positions = points.positions.clone()
    accepted = torch.zeros_like(points.times, dtype=torch.bool)
    residuals = torch.zeros_like(points.times)
    for time in points.times.unique().tolist():
        chosen = torch.nonzero(points.times == time).squeeze(-1)
        moved = deformed(present, time)
        inversion = invert_deformation(
            lambda positions: deformed(positions, time),  # noqa: B023  called before the next time
            points.positions[chosen],
            moved,
            moved - present,
            ACCEPTED * points.scales[chosen],
        )
        positions[chosen], accepted[chosen], residuals[chosen] = inversion
    return Inversion(positions, accepted, residuals)


def invert_some(
    points: Points, chosen: Tensor, deformed: Callable[[Tensor, float], Tensor], present: Tensor
) -> tuple[Points, Inversion]:
    """The points with those of a mask [K] at their canonical positions; the rest as in `invert_at_times`."""
    inversion = invert_at_times(points.select(chosen), deformed, present)
    positions = points.positions.clone()
    positions[chosen] = inversion.positions
    return points._replace(positions=positions), inversion


def values_of_neighbours(points: Points, means_at: Callable[[float], Tensor], values: Tensor) -> Tensor:
    """For each point the row of `values` [N, ...] of the Gaussian that is nearest at the point's own time, [K, ...].

    `means_at` gives the positions [N, 3] at a time; zeros where there is no Gaussian.
    """
    nearest = values.new_zeros(len(points.positions), *values.shape[1:])
    for time in points.times.unique().tolist() if len(values) else ():
        chosen = points.times == time
        nearest[chosen] = neighbour_offsets(points.positions[chosen], means_at(time).detach(), values)
    return nearest

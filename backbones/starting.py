"""What a backbone starts from: coloured points as isotropic Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from d2_plugin.gaussians import spherical_harmonics as sh
from d2_plugin.gaussians.nearest import nearest
from d2_plugin.protocol import Points


def isotropic_rows(points: Points, sh_degree: int, sh_time_degree: int = 0) -> dict[str, Tensor]:
    """The raw rows that every backbone has."""
    coefficients = sh.coefficients_from_rgb(points.colors, sh_degree, sh_time_degree)
    rows = {
        "positions": points.positions,
        "log_scales": points.scales.log()[:, None].repeat(1, 3),
        "opacity_logits": torch.logit(points.opacities, eps=1e-6),
        "base_colors": coefficients[:, :1],
    }
    if coefficients.shape[1] > 1:
        rows["harmonics"] = coefficients[:, 1:]
    return rows


def lasting_rows(points: Points, longest: float) -> dict[str, Tensor]:
    """Those of Gaussians that exist around their instants, for as long as their lifetimes and no longer than that."""
    lives = torch.full_like(points.scales, math.log(longest))
    return {
        "times": points.times,
        "log_time_scales": lives if points.lifetimes is None else torch.minimum(lives, points.lifetimes.log()),
    }


def nearest_neighbour_scales(positions: Tensor) -> Tensor:
    """Root mean square distance [N] to the three nearest points, or all others if they are fewer, at least 1e-7.

    A lone point gets 1e-2.
    """
    count = len(positions)
    if count < 2:
        return positions.new_full((count,), 1e-2)
    distances, _ = nearest(positions, positions, min(3, count - 1) + 1)
    return distances[:, 1:].square().mean(-1).sqrt().clamp(min=1e-7)

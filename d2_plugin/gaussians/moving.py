"""Gaussians on straight lines that fade in time: what a 4D Gaussian is, exactly, in the words that players know.

With mean (m, mu_t) and covariance S = [[S_xx, S_xt], [S_tx, S_tt]] a 4D Gaussian at time t is the 3D Gaussian with
    centre      m + v (t - mu_t),                        v = S_xt / S_tt
    covariance  S_xx - S_xt S_tx / S_tt                  constant in time
    opacity     o F(t),  F(t) = exp(-(t - mu_t)^2 / (2 sigma^2)),  sigma = sqrt(S_tt)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from d2_plugin.gaussians.rotation4d import (
    condition_on_time,
    covariances_from_factors,
    rotation_matrices_3d,
    rotation_matrices_4d,
    unit_quaternions,
)
from d2_plugin.gaussians.slicing import LOG_SCALE_LIMIT


class LinearMotion(NamedTuple):
    """How each Gaussian moves and fades."""

    velocities: Tensor  # [N, 3] world units per unit of time
    times: Tensor  # [N] mu_t, when it is at `MovingGaussians.positions`
    sigmas: Tensor  # [N] temporal standard deviation


class Harmonics(NamedTuple):
    """Colours as spherical harmonics times cosines in time, see `spherical_harmonics.colors`."""

    coefficients: Tensor  # [N, (degree + 1)^2 (time_degree + 1), 3]
    degree: int
    time_degree: int = 0

    def without_time(self, phase: Tensor | None = None) -> Tensor:
        """Coefficients [N, (degree + 1)^2, 3] at `phase` [N], (t - mu_t) / duration; at t = mu_t if not given.

        For formats without cosines in time."""
        parts = self.coefficients.unflatten(1, (self.time_degree + 1, (self.degree + 1) ** 2))
        if phase is None:
            return parts.sum(1)
        orders = torch.arange(self.time_degree + 1).to(phase)
        return (parts * torch.cos(2 * math.pi * phase[:, None] * orders)[..., None, None]).sum(1)


@dataclass(frozen=True, eq=False)
class MovingGaussians:
    """N Gaussians in float64; without `motion` they stand still and are always there."""

    positions: Tensor  # [N, 3] world
    covariances: Tensor  # [N, 6] xx xy xz yy yz zz
    opacities: Tensor  # [N] in 0..1, without the temporal factor
    harmonics: Harmonics
    motion: LinearMotion | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, rows: Tensor) -> MovingGaussians:
        """The Gaussians `rows`, an index or a mask, in its order."""
        motion = None if self.motion is None else LinearMotion(*(part[rows] for part in self.motion))
        harmonics = self.harmonics._replace(coefficients=self.harmonics.coefficients[rows])
        return MovingGaussians(self.positions[rows], self.covariances[rows], self.opacities[rows], harmonics, motion)


@torch.no_grad()
def moving_gaussians(raw: Mapping[str, Tensor], harmonics: Harmonics) -> MovingGaussians:
    """From raw parameters, as `slicing.slice_gaussians` takes them; those without `times` stand still.

    Computed from factors in float64: the covariance of a Gaussian that moves fast, or is thin, stays a covariance.
    """
    wide = {name: value.detach().double().cpu() for name, value in raw.items()}
    harmonics = harmonics._replace(coefficients=harmonics.coefficients.detach().double().cpu())
    positions, opacities = wide["positions"], torch.sigmoid(wide["opacity_logits"])
    left = unit_quaternions(wide["left"])
    scales = wide["log_scales"].T.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
    if "times" not in wide:
        covariances = covariances_from_factors(rotation_matrices_3d(left) * scales)
        return MovingGaussians(positions, covariances, opacities, harmonics)
    lasting = wide["log_time_scales"].clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
    factors = rotation_matrices_4d(left, unit_quaternions(wide["right"])) * torch.cat([scales, lasting[None]])
    spatial, velocities = condition_on_time(factors)
    motion = LinearMotion(velocities.T, wide["times"], factors[3].square().sum(0).sqrt())
    return MovingGaussians(positions, covariances_from_factors(spatial), opacities, harmonics, motion)

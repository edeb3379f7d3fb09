"""Raw parameters of 4D or 3D Gaussians to the 3D Gaussians of one instant, by the kernel or in torch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from d2_plugin.gaussians.native_slice import can_slice, native_slice
from d2_plugin.gaussians.rotation4d import (
    condition_on_time,
    covariances_from_factors,
    rotation_matrices_3d,
    rotation_matrices_4d,
    temporal_marginal,
    time_row,
    unit_quaternions,
)
from d2_plugin.protocol import Splats

MARGINAL_CUT = 0.05
"""A Gaussian whose temporal marginal F(t) is not above this is not drawn (forward.cu:334)."""

LOG_SCALE_LIMIT = 30.0
"""exp of a log-scale beyond +-this would leave the range where float32 squares are finite: such scales saturate."""


def slice_gaussians(raw: Mapping[str, Tensor], time: float = 0.0) -> Splats:
    """The 3D Gaussians at `time` (same unit as `times`), differentiable; for the raw tensors see `native_slice`."""
    slice_in = native_slice if can_slice(raw) else reference_slice
    return Splats(*slice_in(raw, time, MARGINAL_CUT, LOG_SCALE_LIMIT))


def reference_slice(
    raw: Mapping[str, Tensor], time: float, marginal_cut: float, log_scale_limit: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The slice in torch: any dtype and device, and the oracle of `native_slice`, which documents the arguments."""
    if "times" not in raw:
        factors = rotation_matrices_3d(unit_quaternions(raw["left"])) * _scales(raw["log_scales"], log_scale_limit)
        rows = torch.arange(len(raw["positions"]), device=factors.device)
        return raw["positions"], covariances_from_factors(factors), torch.sigmoid(raw["opacity_logits"]), rows
    log_scales = torch.cat([raw["log_scales"], raw["log_time_scales"][:, None]], 1)
    others = [raw[name] for name in ("left", "right", "opacity_logits", "times")]
    parts: tuple[Tensor, ...] = (raw["positions"], log_scales, *others)
    # A Gaussian outside its temporal support is never projected; without a gradient, none of it is 0 * inf.
    with torch.no_grad():
        axes = unit_quaternions(raw["left"]), unit_quaternions(raw["right"])
        last = time_row(*axes) * _scales(log_scales, log_scale_limit)
        alive = temporal_marginal(time - raw["times"], last.square().sum(0)) > marginal_cut
        rows = rows_to_draw(alive)
    if len(rows) < len(log_scales):
        parts = tuple(part.index_select(0, rows) for part in parts)
    positions, log_scales, left, right, logits, times = parts
    if alive.is_cuda:  # all rows are here: those outside their support get an opacity of 0 and harmless numbers
        log_scales, times = torch.where(alive[:, None], log_scales, 0.0), torch.where(alive, times, time)
        logits = torch.where(alive, logits, -torch.inf)
    rotation = rotation_matrices_4d(unit_quaternions(left), unit_quaternions(right))
    factors = rotation * _scales(log_scales, log_scale_limit)
    spatial, velocity = condition_on_time(factors)
    offset = time - times
    means = positions + (velocity * offset).T
    opacities = torch.sigmoid(logits) * temporal_marginal(offset, factors[3].square().sum(0))
    return means, covariances_from_factors(spatial), opacities, rows


def rows_to_draw(alive: Tensor) -> Tensor:
    """Rows [M] where `alive` is True; all N on a GPU, since M would be waited for: others get an opacity of 0 there."""
    return torch.arange(len(alive), device=alive.device) if alive.is_cuda else torch.nonzero(alive).squeeze(-1)


def _scales(log_scales: Tensor, limit: float) -> Tensor:
    return log_scales.T.contiguous().clamp(-limit, limit).exp()

"""Scale-and-shift-invariant loss of inverse depth, as nerfstudio's surface models use monocular depth.

Ranftl, Lasinger, Hafner, Schindler and Koltun, "Towards Robust Monocular Depth Estimation" (MiDaS, TPAMI 2022), eq. 1,
4 and 11, as nerfstudio has them (`ScaleAndShiftInvariantLoss`). With x the rendered inverse depth, y the map, M pixels,

    (s, t) = argmin sum (s x + t - y)^2,
    L = 1 / (2 M) sum (s x + t - y)^2 + alpha sum_{k=0..3} 1 / M_k sum (|d/dx R_k| + |d/dy R_k|)

where R_k is the residual at every 2^k-th pixel and M_k their number; alpha = 0.5. The gradient flows through s and t.
The weight is MonoSDF's 0.1 (Yu et al., NeurIPS 2022). Maps are brought to 0..1, which is this project's choice.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.rivals.inputs import RivalLoss, expected_depth, in_unit_range
from benchmarks.rivals.pearson import FLAT
from d2_plugin.hooks import Context, HookConfig
from d2_plugin.hooks.depth_loss import depth_and_alpha
from d2_plugin.protocol import View
from d2_plugin.settings import AtLeastOne, NotNegative, Share


@dataclass(frozen=True)
class ScaleShiftConfig(HookConfig):
    """Scale-and-shift-invariant inverse depth (MiDaS, nerfstudio)."""

    weight: NotNegative = 0.1
    """Of the loss, as published."""
    alpha: NotNegative = 0.5
    """Of the gradient term, as published."""
    scales: AtLeastOne = 4
    """Of the gradient term, as published."""
    tau_v: Share = 0.5
    """Pixels whose accumulated alpha does not exceed this have no rendered depth."""


def fitted_scale_and_shift(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """(s, t) that minimise sum (s x + t - y)^2 over lists [K]; 0 and 0 where x is constant, as published."""
    centred = x - x.mean()
    power = centred.square().mean()
    varies = power > FLAT * x.square().mean()
    scale = torch.where(varies, (centred * (y - y.mean())).mean(), 0) / torch.where(varies, power, 1)
    return scale, torch.where(varies, y.mean() - scale * x.mean(), 0)


def scale_shift_loss(
    inverse_render: Tensor, inverse_depth: Tensor, mask: Tensor, alpha: float = 0.5, scales: int = 4
) -> Tensor:
    """The loss of one view, a scalar; 0 with zero gradients where `mask` is empty.

    Args:
        inverse_render: x [H, W].
        inverse_depth: y [H, W].
    """
    x, y = torch.where(mask, inverse_render, 0), torch.where(mask, inverse_depth, 0)
    if not mask.any():
        return 0.0 * x.sum()
    scale, shift = fitted_scale_and_shift(x[mask], y[mask])
    residual = torch.where(mask, scale * x + shift - y, 0)
    total = residual.square().sum() / (2 * mask.sum())
    for step in (2**k for k in range(scales if alpha else 0)):
        total = total + alpha * gradient_term(residual[::step, ::step], mask[::step, ::step])
    return total


def gradient_term(residual: Tensor, mask: Tensor) -> Tensor:
    """1 / M sum of |differences| of a residual [H, W] between neighbours that both count."""
    columns = (residual[:, 1:] - residual[:, :-1]).abs() * (mask[:, 1:] & mask[:, :-1])
    rows = (residual[1:] - residual[:-1]).abs() * (mask[1:] & mask[:-1])
    return (columns.sum() + rows.sum()) / mask.sum().clamp(min=1)


class ScaleShift(RivalLoss):
    """Adds the loss of the views of the present step."""

    config: ScaleShiftConfig

    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view, None where it has no map."""
        inverse = self.inputs.inverse_depth(view)
        if inverse is None:
            return None
        depth, valid = expected_depth(*depth_and_alpha(context, view), self.config.tau_v)
        known = inverse.isfinite()
        x = torch.where(valid, 1 / torch.where(valid, depth, 1), 0)
        y = in_unit_range(torch.where(known, inverse, 0), known)
        return scale_shift_loss(x, y, valid & known, self.config.alpha, self.config.scales)

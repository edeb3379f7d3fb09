"""Verified-depth supervision (paper, section "RGB-D Joint Optimization")."""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.config import DepthLossConfig
from d2_plugin.protocol import DepthPrior, View
from d2_plugin.rasterizer import rasterize

from .hook import Context, Hook, Window
from .rendered_depth import EPSILON, rendered_depth


def charbonnier(residual: Tensor, epsilon: float) -> Tensor:
    """rho(r) = sqrt(r^2 + epsilon^2) - epsilon, elementwise, without cancellation near 0 or overflow of r^2."""
    root = torch.hypot(residual, residual.new_tensor(epsilon))
    return residual * (residual / (root + epsilon))


def depth_loss(depth: Tensor, valid: Tensor, prior: Tensor, verified: Tensor, epsilon: float) -> Tensor:
    """L_depth: mean of rho((D_hat - D*) / (D* + eps)) over pixels that are verified and validly rendered; a scalar.

    All maps [H, W]; 0 with zero gradients where there is no such pixel. Pixels are selected before any arithmetic,
    so NaN or infinity elsewhere in the prior cannot leak in.
    """
    mask = valid & verified
    target = torch.where(mask, prior, torch.ones_like(prior))
    residual = torch.where(mask, depth - target, torch.zeros_like(depth)) / (target + EPSILON)
    return charbonnier(residual, epsilon).sum() / (mask.sum() + EPSILON)


class DepthLoss(Hook):
    """Adds lambda_d L_depth of the views of the present step."""

    def __init__(self, config: DepthLossConfig) -> None:
        self.config = config
        self.window = Window(config.start, config.stop, config.every)

    def loss(self, context: Context) -> Tensor | None:
        """lambda_d times the mean of L_depth over the step's views that have verified pixels."""
        pairs = [(view, context.prior(view)) for view in context.views]
        terms = [
            self._term(context, view, prior) for view, prior in pairs if prior is not None and prior.verified.any()
        ]
        return self.config.weight * torch.stack(terms).mean() if terms else None

    def _term(self, context: Context, view: View, prior: DepthPrior) -> Tensor:
        depth_sum, alpha = depth_and_alpha(context, view)
        depth, valid = rendered_depth(depth_sum, alpha, self.config.tau_v)
        return depth_loss(depth, valid, prior.depth, prior.verified, self.config.epsilon)


def depth_and_alpha(context: Context, view: View) -> tuple[Tensor, Tensor]:
    """Differentiable sum of w z and alpha [H, W] of a view: the trainer's own render where it has both, else ours."""
    own = getattr(context.backbone, "rendered_depth", None)
    rendered = own(view) if own is not None else None
    if rendered is not None:
        return rendered
    splats = context.backbone.slice_at(view)
    colors = splats.means.new_zeros(len(splats.means), 1)
    render = rasterize(splats, colors, view, context.backbone.settings)
    return render.depth_sum, render.alpha

"""Verified-depth supervision (paper, section "RGB-D Joint Optimization"), each pixel by what its depth is worth.

The paper takes the mean over Omega^v. Here a pixel with relative standard deviation sigma counts by
min(1, sigma_full / sigma), and its penalty is flat within sigma: epsilon^2 grows by sigma^2. With sigma 0 at verified
pixels and infinite elsewhere that is the paper's. Far pixels are penalised only where the render is nearer than they,
near ones also for the light that they let through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.hooks.hook import Context, Hook, HookConfig
from d2_plugin.hooks.native_depth_loss import Constants, can_compare, native_depth_loss
from d2_plugin.hooks.prior import KnownPixels
from d2_plugin.hooks.rendered_depth import EPSILON
from d2_plugin.protocol import View
from d2_plugin.rasterizer import rasterize
from d2_plugin.settings import Every, Positive, Range, Share, Steps


@dataclass(frozen=True)
class DepthLossConfig(HookConfig):
    """Verified-depth supervision."""

    start: Steps = 1
    """First step at which it is added."""
    stop: Steps | None = None
    """First step at which it is no longer added; none: to the end."""
    every: Every = 1
    """Steps between additions."""
    weight: Annotated[float, Range(0, 1e6)] = 0.2
    """lambda_d of each addition; what matters is weight / every."""
    opaque: Annotated[float, Range(0, 1e6)] = 0.05
    """Beside lambda_d's 1, the weight of what known near pixels let through, mean of 1 - alpha; the paper has none. A
    background of the same colour could else stand for a surface: 500 steps, seed 0, studio 29.9 dB and depth AbsRel
    .071 without, 30.7 and .032 with; plaza, where the sky is one, 22.0 and .123, 21.8 and .122."""
    epsilon: Positive = 0.01
    """epsilon_rho of the Charbonnier penalty, on relative depth residuals."""
    tau_v: Share = 0.5
    """Pixels whose accumulated alpha does not exceed this are left out."""
    sigma_full: Positive = 0.05
    """Relative standard deviation up to which a pixel counts in full; beyond it, in proportion to sigma_full / sigma.
    An earlier version, plaza, 5 frames, 2000 steps, one seed: 20.96 dB and depth AbsRel .117 at .02, 21.04 dB and .112
    at .05; 19.96 dB and .127 with trusted pixels alone."""


def charbonnier(residual: Tensor, epsilon: float | Tensor) -> Tensor:
    """rho(r) = sqrt(r^2 + epsilon^2) - epsilon, elementwise, without cancellation near 0 or overflow of r^2."""
    root = torch.hypot(residual, torch.as_tensor(epsilon).to(residual))
    return residual * (residual / (root + epsilon))


def depth_loss(
    depth: Tensor, valid: Tensor, prior: Tensor, weight: Tensor, epsilon: float | Tensor, far: Tensor | None = None
) -> Tensor:
    """L_depth: weighted mean of rho((D_hat - D*) / (D* + eps)) over validly rendered pixels; a scalar.

    The paper's has weight 1 at verified pixels and 0 elsewhere. Pixels are selected before any arithmetic, so NaN or
    infinity elsewhere in the prior cannot leak in; 0 with zero gradients where no pixel counts.

    Args:
        depth, valid: D_hat and M^r of a render, [H, W].
        prior: D* [H, W].
        weight: how much each pixel counts [H, W], 0..1.
        epsilon: epsilon_rho of the Charbonnier penalty, one number or a map [H, W].
        far: bool [H, W], pixels where only a depth in front of D* is wrong.
    """
    mask = valid & (weight > 0)
    target = torch.where(mask, prior, torch.ones_like(prior))
    residual = torch.where(mask, depth - target, torch.zeros_like(depth)) / (target + EPSILON)
    if far is not None:
        residual = torch.where(far, residual.clamp(max=0), residual)
    counted = torch.where(mask, weight, 0).to(depth)
    return (counted * charbonnier(residual, epsilon)).sum() / (counted.sum() + EPSILON)


class _PixelDepthLoss(torch.autograd.Function):
    """`pixel_depth_loss` with its gradient in closed form, made along with the value: a graph of a dozen full maps
    costs 2.7 ms a step at 320x180 on one thread, this .5 ms (medians)."""

    @staticmethod
    def forward(context: Any, depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, config: DepthLossConfig) -> Tensor:
        tau_v = config.tau_v
        z, a = (values.flatten().index_select(0, pixels.index) for values in (depth_sum, alpha))
        weight = (config.sigma_full / pixels.sigma.clamp(min=config.sigma_full)) * (a > tau_v)
        opaque = a.clamp(min=tau_v) + EPSILON
        target = pixels.depth + EPSILON
        depth = z / opaque
        residual = (depth - pixels.depth) / target
        residual = torch.where(pixels.far, residual.clamp(max=0), residual)
        epsilon = torch.hypot(pixels.sigma, pixels.sigma.new_tensor(config.epsilon))
        root = torch.hypot(residual, epsilon)
        total = weight.sum() + EPSILON
        slope = weight * (residual / root) / (target * opaque * total)  # d loss / d depth_sum
        near = (~pixels.far).to(a) * (config.opaque / max(pixels.near, 1))
        context.save_for_backward(pixels.index, slope, -slope * depth - near)
        context.shape = depth_sum.shape
        return (weight * residual * (residual / (root + epsilon))).sum() / total + (near * (1 - a)).sum()

    @staticmethod
    @once_differentiable
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        index, by_depth_sum, by_alpha = context.saved_tensors

        def scattered(values: Tensor) -> Tensor:
            flat = values.new_zeros(context.shape.numel())
            return flat.index_copy_(0, index, values).view(context.shape)

        return scattered(gradient * by_depth_sum), scattered(gradient * by_alpha), None, None


def pixel_depth_loss(
    depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, config: DepthLossConfig, factor: float = 1.0
) -> Tensor:
    """L_depth of a render: `depth_loss` of `rendered_depth` plus `opaque` times the mean of 1 - alpha at near pixels,
    computed at the known pixels alone; by a kernel where there is one.

    Args:
        depth_sum, alpha: sum of w z and of w, [H, W], differentiable once.
        pixels: where something is known of D*, and how much.
        config: tau_v, epsilon, sigma_full and opaque.
        factor: what the result is multiplied by.
    """
    if can_compare(depth_sum, alpha, pixels):
        constants = Constants(config.tau_v, config.sigma_full, config.epsilon, config.opaque, factor)
        return native_depth_loss(depth_sum, alpha, pixels, constants)
    return factor * _PixelDepthLoss.apply(depth_sum, alpha, pixels, config)


class DepthLoss(Hook):
    """Adds lambda_d L_depth of the views of the present step."""

    config: DepthLossConfig

    def loss(self, context: Context) -> Tensor | None:
        """lambda_d times the mean of L_depth over the step's views that have known pixels."""
        pairs = [(view, context.prior.known(view)) for view in context.views]
        known = [(view, pixels) for view, pixels in pairs if pixels is not None]
        factor = self.config.weight / max(len(known), 1)
        terms = [
            pixel_depth_loss(*depth_and_alpha(context, view), pixels, self.config, factor) for view, pixels in known
        ]
        return torch.stack(terms).sum() if len(terms) > 1 else next(iter(terms), None)


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

"""Verified-depth supervision (paper, section "RGB-D Joint Optimization"), each pixel by what its depth is worth.

The paper takes the mean over Omega^v. Here a pixel with relative standard deviation sigma counts by
min(1, sigma_full / sigma), and its penalty is flat within sigma: epsilon^2 grows by sigma^2. With sigma 0 at verified
pixels and infinite elsewhere that is the paper's. Far pixels are penalised only where the render is nearer than they,
near ones also for the light that they let through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.hooks.densify import EPSILON, rendered_depth
from d2_plugin.hooks.expected import check_device
from d2_plugin.hooks.hook import Context, Hook, HookConfig
from d2_plugin.hooks.native_depth_loss import can_compare, native_depth_loss
from d2_plugin.hooks.prior import FAR, NEAR, KnownMaps
from d2_plugin.protocol import View, call_optional
from d2_plugin.rasterizer import rasterize
from d2_plugin.settings import Range, Share


@dataclass(frozen=True)
class DepthLossConfig(HookConfig):
    """Verified-depth supervision."""

    weight: Annotated[float, Range(0, 1e6)] = 0.2
    """lambda_d of each addition; what matters is weight / every."""
    opaque: Annotated[float, Range(0, 1e6)] = 0.05
    """Beside lambda_d's 1, the weight of what known near pixels let through, mean of 1 - alpha; the paper has none. A
    background of the same colour could else stand for a surface."""
    epsilon: Annotated[float, Range(1e-6, 1e6)] = 0.01
    """epsilon_rho of the Charbonnier penalty, on relative depth residuals."""
    tau_v: Share = 0.5
    """Pixels whose accumulated alpha does not exceed this are left out."""
    sigma_full: Annotated[float, Range(1e-6, 1e6)] = 0.05
    """Relative standard deviation up to which a pixel counts in full; beyond it, as sigma_full / sigma."""


def charbonnier(residual: Tensor, epsilon: float | Tensor) -> Tensor:
    """rho(r) = sqrt(r^2 + epsilon^2) - epsilon, elementwise, without cancellation near 0 or overflow of r^2."""
    epsilon = epsilon.to(residual) if isinstance(epsilon, Tensor) else torch.full_like(residual, epsilon)
    root = torch.hypot(residual, epsilon)
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
    counted = torch.where(mask, weight, 0).to(residual)
    return (counted * charbonnier(residual, epsilon)).sum() / (counted.sum() + EPSILON)


def supervision(
    depth_sum: Tensor, alpha: Tensor, known: KnownMaps, config: DepthLossConfig, factor: float = 1.0
) -> Tensor:
    """L_depth of a render: `depth_loss` of `rendered_depth`, and `opaque` times the mean of 1 - alpha at near pixels.

    float32 on the CPU runs in a kernel, where there is a compiler.

    Args:
        depth_sum, alpha: sum of w z and of w, [H, W], differentiable once.
        known: where something is known of D*, and how well; at least one pixel.
        config: tau_v, epsilon, sigma_full and opaque.
        factor: what the result is multiplied by.
    """
    if can_compare(depth_sum, alpha, known):
        constants = (config.tau_v, config.sigma_full, config.epsilon, config.opaque, factor)
        return native_depth_loss(depth_sum, alpha, known, constants)
    near, far = known.kind == NEAR, known.kind == FAR
    sigma = torch.zeros_like(known.depth) if known.sigma is None else torch.where(near, known.sigma, 0.0)
    weight = torch.where(known.kind > 0, config.sigma_full / sigma.clamp(min=config.sigma_full), 0.0)
    epsilon = torch.hypot(sigma, torch.full_like(sigma, config.epsilon))
    depth, valid = rendered_depth(depth_sum, alpha, config.tau_v)
    through = torch.where(near, 1 - alpha, 0.0).sum() / max(known.near, 1)
    return factor * (depth_loss(depth, valid, known.depth, weight, epsilon, far) + config.opaque * through)


class DepthLoss(Hook):
    """Adds lambda_d L_depth of the views of the present step."""

    config: DepthLossConfig

    def loss(self, context: Context) -> Tensor | None:
        """lambda_d times the mean of L_depth over the step's views that have known pixels."""
        pairs = [(view, context.prior.known(view)) for view in context.views]
        supervised = [(view, known) for view, known in pairs if known is not None]
        factor = self.config.weight / max(len(supervised), 1)
        terms = [supervision(*depth_and_alpha(context, view), known, self.config, factor) for view, known in supervised]
        return torch.stack(terms).sum() if len(terms) > 1 else next(iter(terms), None)


def depth_and_alpha(context: Context, view: View) -> tuple[Tensor, Tensor]:
    """Differentiable sum of w z and alpha [H, W] of a view: the trainer's own render where it has both, else ours."""
    rendered: tuple[Tensor, Tensor] | None = call_optional(context.backbone, "rendered_depth", view)
    if rendered is not None:
        size, trains = (view.height, view.width), torch.is_grad_enabled()
        if any(part.shape != size or part.requires_grad < trains for part in rendered):
            got = " and ".join(
                f"{tuple(part.shape)}{' with' if part.requires_grad else ' without'}" for part in rendered
            )
            raise D2Error(
                f"rendered_depth() returned {got} gradients, expected {size} twice, both with: mend the adapter, or "
                "return None, and D2 renders"
            )
        return rendered
    splats = context.backbone.slice_at(view)
    check_device(splats, view)
    colors = splats.means.new_zeros(len(splats.means), 1)
    render = rasterize(splats, colors, view, context.backbone.settings)
    return render.depth_sum, render.alpha

"""Depth normalised patch by patch, hard and soft, as DNGaussian guides sparse views.

Li, Zhang, Yan, Han, Hou and Bai, "DNGaussian: Optimizing Sparse-View 3D Gaussian Radiance Fields with Global-Local
Depth Normalization" (CVPR 2024), and its code (Fictionarry/DNGaussian: utils/loss_utils.py, train_llff.py). A map D is
cut into patches P of n x n pixels, n drawn from 5..17 at each step. With s the standard deviation of D, without
gradient, and s_P that of all pixels of patches,

    local:  (D - mean_P D) / (std_P D + 0.01 s_P),    global:  (D - mean_P D) / (s + 0.01 s_P)

Either loss is the mean of the squared difference between the normalised render (sum of w z) and the normalised map
(flipped, so that it grows with depth), over differences above the tolerance; they add up as 0.1 local + 1 global.
Hard: every Gaussian is drawn with opacity 0.95, and only positions learn. Soft, from a sixth of the run on (1000 of
6000 steps): only opacities learn. Of a 4D Gaussian neither reaches lifetime or velocity (`hard_and_soft`). Published
with an optimizer step for each, of the one Adam; here they join that of the photometric loss. What is drawn stands
before black, as published: s has no gradient, so that the soft loss makes the render fainter wherever it is wrong, and
before a learnt background nothing would hold against it. Left out: smoothness and shape penalties, neural colours.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.rivals.inputs import RivalLoss, rendered_again
from d2_plugin.hooks import Context, HookConfig
from d2_plugin.protocol import Splats, View
from d2_plugin.settings import NotNegative, Range, Steps

GUARD = 0.01
"""Share of the whole map's deviation that keeps flat patches from dividing by 0, as published."""


@dataclass(frozen=True)
class PatchNormConfig(HookConfig):
    """Patch-normalised depth (DNGaussian)."""

    weight: NotNegative = 1.0
    """Of the sum of both losses."""
    local_weight: NotNegative = 0.1
    """Of the locally normalised loss, as published."""
    global_weight: NotNegative = 1.0
    """Of the globally normalised loss, as published."""
    smallest_patch: Annotated[int, Range(2, unit="pixels")] = 5
    """Side of the smallest patch, as published."""
    largest_patch: Annotated[int, Range(2, unit="pixels")] = 17
    """Side of the largest patch, as published."""
    tolerance: NotNegative = 0.00025
    """Differences up to this are left alone, as published for LLFF."""
    hard_opacity: Annotated[float, Range(0, 1, open_low=True, open_high=True)] = 0.95
    """Of every Gaussian where centres learn, as published."""
    soft_start: Steps = 1000
    """First step at which opacities learn from depth, as published of 6000 steps."""

    @classmethod
    def for_iterations(cls, iterations: int) -> Self:
        """The soft loss from a sixth of the run on."""
        return cls(soft_start=max(iterations // 6, 1))


def patches(values: Tensor, side: int) -> Tensor:
    """[P, side * side]: the whole patches of a map [H, W], row by row; what is left over at the rim is dropped."""
    return F.unfold(values[None, None], side, stride=side)[0].T


def patch_norm_loss(depth: Tensor, target: Tensor, side: int, tolerance: float, whole: bool) -> Tensor:
    """One of the two losses, a scalar; 0 with zero gradients where there is no patch or no difference.

    Args:
        depth, target: render and map [H, W], both growing with depth.
        tolerance: differences up to this do not count.
        whole: normalise by the deviation of the whole map (global) instead of the patch's own (local).
    """
    if min(depth.shape) < side:
        return 0.0 * depth.sum()
    difference = _normalised(depth, side, whole) - _normalised(target, side, whole)
    counted = difference.abs() > tolerance
    return torch.where(counted, difference, 0).square().sum() / counted.sum().clamp(min=1)


def _normalised(values: Tensor, side: int, whole: bool) -> Tensor:
    cut = patches(values, side)
    deviation = _deviation(values).detach() if whole else _deviation(cut, 1)
    divisor = deviation + GUARD * _deviation(cut)
    flat = divisor <= 1e-6 * values.detach().abs().mean()  # a constant map: rounding must not pass for shape
    centred = cut - cut.mean(1, keepdim=True)
    return torch.where(flat, 0, centred / torch.where(flat, 1, divisor))


def _deviation(values: Tensor, dim: int | None = None) -> Tensor:
    """Sample standard deviation with gradient 0, not NaN, where all values are the same."""
    variance = values.var() if dim is None else values.var(dim, keepdim=True)
    positive = variance > 0
    return torch.where(positive, torch.where(positive, variance, 1).sqrt(), 0)


def hard_and_soft(backbone: Any, view: View, hard_opacity: float) -> tuple[Splats, Splats]:
    """The splats of hard depth, of which positions alone learn, and of soft depth, of which opacities alone do.

    Velocities and lifetimes, which the published 3D Gaussians do not have, learn from neither. A Gaussian that is about
    to end or begin at this instant is drawn by that much fainter in both.

    Args:
        backbone: adapter of a bundled backbone, whose `trained` tensors have positions and opacity_logits.
        view: what is rendered.
        hard_opacity: of every Gaussian in hard depth, in the middle of its life.
    """
    splats, trained = backbone.slice_at(view), backbone.trained()
    fixed = Splats(*(part.detach() for part in splats))
    positions = trained["positions"].index_select(0, splats.rows)
    opacities = trained["opacity_logits"].index_select(0, splats.rows).sigmoid()
    alive = fixed.opacities / opacities.detach()
    hard = fixed._replace(means=fixed.means + (positions - positions.detach()), opacities=hard_opacity * alive)
    return hard, fixed._replace(opacities=alive * opacities)


class PatchNorm(RivalLoss):
    """Adds the losses of hard and soft depth for the views of the present step."""

    config: PatchNormConfig

    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view, None where it has no map."""
        inverse = self.inputs.inverse_depth(view)
        if inverse is None:
            return None
        target = -torch.where(inverse.isfinite(), inverse, inverse.nanmean())
        hard, soft = hard_and_soft(context.backbone, view, self.config.hard_opacity)
        total = self._losses(rendered_again(context, view, hard), target, context.generator)
        if context.step > self.config.soft_start:
            total = total + self._losses(rendered_again(context, view, soft), target, context.generator)
        return total

    def _losses(self, depth: Tensor, target: Tensor, generator: torch.Generator) -> Tensor:
        config, low, high = self.config, self.config.smallest_patch, self.config.largest_patch
        sides = torch.randint(low, max(high, low) + 1, (2,), generator=generator).tolist()
        local = patch_norm_loss(depth, target, sides[0], config.tolerance, whole=False)
        globally = patch_norm_loss(depth, target, sides[1], config.tolerance, whole=True)
        return config.local_weight * local + config.global_weight * globally

"""Pearson correlation of rendered and monocular depth, as FSGS guides a static scene.

Zhu, Fan, Jiang and Wang, "FSGS: Real-Time Few-shot View Synthesis using Gaussian Splatting" (ECCV 2024), section 3.3,
and its code (VITA-Group/FSGS, train.py): with m the map of MiDaS (inverse depth) and D the rendered sum of w z,

    L = min( 1 - r(-m, D), 1 - r(1 / (m + 200), D) ),    r(x, y) = cov(x, y) / sqrt(var(x) var(y))

weighted by 0.05, and by 0.001 in the last twentieth of training. gsplat has the same correlation as
`gsplat.losses.pearson_depth_loss` (1 - r of depth pairs). Left out: FSGS's pseudo views, which need a network while
training.
"""

from dataclasses import dataclass
from typing import Annotated, Self

import torch
from torch import Tensor

from benchmarks.rivals.inputs import RivalLoss, in_unit_range
from d2_plugin.hooks import Context, HookConfig
from d2_plugin.hooks.depth_loss import depth_and_alpha
from d2_plugin.protocol import View
from d2_plugin.settings import NotNegative, Positive, Range, Steps

FLAT = 1e-10
"""A map whose variance is a smaller share of its mean square is constant: rounding alone varies it."""


@dataclass(frozen=True)
class PearsonConfig(HookConfig):
    """Pearson correlation of depth (FSGS)."""

    weight: NotNegative = 0.05
    """Of the loss, as published."""
    late: Steps = 9500
    """First step with the later weight, as published of 10,000 steps."""
    late_weight: NotNegative = 0.001
    """Of the loss from then on, as published."""
    span: Positive = 2000.0
    """Largest value that a map is brought to before `offset` is added. MiDaS's maps have some such range, those of
    other networks another one; this project's choice."""
    offset: Annotated[float, Range(0, open_low=True)] = 200.0
    """Added before a map is inverted, as published."""

    @classmethod
    def for_iterations(cls, iterations: int) -> Self:
        """The later weight in the last twentieth of the run."""
        return cls(late=max(round(0.95 * iterations), 1))


def pearson_correlation(x: Tensor, y: Tensor) -> Tensor:
    """r(x, y) of two lists [K] of values, a scalar; 0 without gradient where one is constant or has fewer than two."""
    if len(x) < 2:
        return 0.0 * x.sum()
    x_centred, y_centred = x - x.mean(), y - y.mean()
    x_power, y_power = x_centred.square().mean(), y_centred.square().mean()
    varies = (x_power > FLAT * x.square().mean()) & (y_power > FLAT * y.square().mean())
    one = torch.ones_like(x_power)
    # Roots apart: the product of two small variances underflows in float32.
    scale = torch.where(varies, x_power, one).sqrt() * torch.where(varies, y_power, one).sqrt()
    return torch.where(varies, (x_centred * y_centred).mean(), torch.zeros_like(one)) / scale


def pearson_depth_loss(depth: Tensor, inverse_depth: Tensor, span: float = 2000.0, offset: float = 200.0) -> Tensor:
    """FSGS's loss of one view, a scalar in 0..2; 1 where nothing can be told.

    Args:
        inverse_depth: monocular map [H, W], larger is nearer; NaN where there is none.
        span: what the map's largest value is brought to, its smallest to 0.
    """
    known = inverse_depth.isfinite()
    d, m = depth[known], span * in_unit_range(inverse_depth, known)[known]
    if len(m) < 2:
        return 1 + 0.0 * d.sum()
    return 1 - torch.maximum(pearson_correlation(-m, d), pearson_correlation(1 / (m + offset), d))


class Pearson(RivalLoss):
    """Adds the loss of the views of the present step."""

    config: PearsonConfig

    def weight(self, step: int) -> float:
        """As published, another one late in the run."""
        return self.config.weight if step < self.config.late else self.config.late_weight

    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view, None where it has no map."""
        inverse = self.inputs.inverse_depth(view)
        if inverse is None:
            return None
        return pearson_depth_loss(depth_and_alpha(context, view)[0], inverse, self.config.span, self.config.offset)

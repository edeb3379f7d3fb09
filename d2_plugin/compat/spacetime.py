"""`diff_gaussian_rasterization_ch3` and `_ch9` of oppo-us-research/SpacetimeGaussians: 3 or 9 channels, and a depth.

The original's depth is the median one, where transmittance falls below one half, and 15.0 where it never does; it has
no gradient. Here it is the mean depth of those pixels, and 15.0 at the others: the trainer takes quantiles of it for
the span of its own insertions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.compat import inria
from d2_plugin.compat.inria import GaussianRasterizationSettings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

NO_DEPTH = 15.0
"""Of pixels that let more than half of the light through (forward.cu:308)."""


class GaussianRasterizer(inria.GaussianRasterizer):
    """As in 3DGS with the channels that the colours have, and a depth [1, H, W] without gradients."""

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **others: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Channels [C, H, W], radii [N] int32 and depth [1, H, W]."""
        drawn = self._draw(means3D, means2D, opacities, **others)
        depth, alpha = drawn.depth.detach(), drawn.alpha.detach()
        return drawn.color, drawn.radii, torch.where(alpha > 0.5, depth / alpha, NO_DEPTH)

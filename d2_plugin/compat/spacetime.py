"""`diff_gaussian_rasterization_ch3` and `_ch9` of oppo-us-research/SpacetimeGaussians: 3 or 9 channels, and a depth.

The original's depth is the median one, where transmittance falls below one half, and 15.0 where it never does; it has
no gradient. Here it is the mean depth of those pixels, and 15.0 at the others: the trainer takes quantiles of it for
the span of its own insertions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from d2_plugin.compat import threedgs

NO_DEPTH = 15.0
"""Of pixels that let more than half of the light through (forward.cu:308)."""


class GaussianRasterizationSettings(NamedTuple):
    """The camera and constants of one image, as in the original; matrices act on row vectors."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    antialiasing: bool = False


class GaussianRasterizer(threedgs.GaussianRasterizer):
    """As in 3DGS with the channels that the colours have, and a depth [1, H, W] without gradients."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Channels [C, H, W], radii [N] int32 and depth [1, H, W]."""
        drawn = self._draw(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        depth, alpha = drawn.depth.detach(), drawn.alpha.detach()
        return drawn.color, drawn.radii, torch.where(alpha > 0.5, depth / alpha, NO_DEPTH)

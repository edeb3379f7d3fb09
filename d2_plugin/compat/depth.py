"""The depth variants of `diff_gaussian_rasterization`: color, radii and the un-normalised depth sum.

hustvl/4DGaussians and ingra14m/Deformable-3D-Gaussians import these under the same name. The latter also passes
`means2D_densify`, whose gradient is the sum over pixels of absolute values there (its issue 72). Here it is the signed
sum, that of `means2D`, which is smaller, so fewer Gaussians exceed its densify_grad_threshold of .0007; 3D Gaussian
Splatting uses .0002 for the signed sum.
"""

from __future__ import annotations

from torch import Tensor

from d2_plugin.compat import inria
from d2_plugin.compat.inria import GaussianRasterizationSettings, warn_once

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(inria.GaussianRasterizer):
    """As in 3DGS, and depth [1, H, W] = sum of w z with gradients."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        means2D_densify: Tensor | None = None,
        **others: Tensor | None,
    ) -> tuple[Tensor, ...]:
        """Color [3, H, W], radii [N] int32 and depth [1, H, W]."""
        if means2D_densify is not None:
            warn_once(
                "means2D_densify receives signed gradients, not sums of absolute ones: the trainer splits fewer "
                "Gaussians, give it --densify_grad_threshold 0.0002"
            )
            means2D = means2D + means2D_densify
        drawn = self._draw(means3D, means2D, opacities, **others)
        return drawn.color, drawn.radii, drawn.depth

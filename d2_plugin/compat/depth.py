"""The depth variants of `diff_gaussian_rasterization`: color, radii and the un-normalised depth sum.

hustvl/4DGaussians and ingra14m/Deformable-3D-Gaussians import these under the same name. The latter passes
`means2D_densify`, which its CUDA source gives the sum of absolute per-pixel gradients; here it receives the signed sum
that `means2D` receives, which is smaller: fewer Gaussians exceed the repository's densification threshold of 0.0007.
"""

from __future__ import annotations

import logging

from torch import Tensor

from . import threedgs
from .threedgs import GaussianRasterizationSettings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

log = logging.getLogger(__name__)


class GaussianRasterizer(threedgs.GaussianRasterizer):
    """As in 3DGS, and depth [1, H, W] = sum of w z with gradients."""

    _told = False

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
        means2D_densify: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Color [3, H, W], radii [N] int32 and depth [1, H, W]."""
        if means2D_densify is not None:
            self._tell()
            means2D = means2D + means2D_densify
        drawn = self._draw(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        return drawn.color, drawn.radii, drawn.depth

    @classmethod
    def _tell(cls) -> None:
        if not cls._told:
            log.warning(
                "means2D_densify receives signed gradients, not the sums of absolute ones of the original: fewer "
                "Gaussians are densified at the same threshold"
            )
        cls._told = True

"""The depth variants of `diff_gaussian_rasterization`: color, radii and the un-normalised depth sum.

hustvl/4DGaussians and ingra14m/Deformable-3D-Gaussians import these under the same name. The latter also passes
`means2D_densify`, whose gradient is the sum over pixels of absolute values (its issue 72), of the colours' share of the
loss here. Without a compiler it receives the signed sum that `means2D` receives, which is smaller, and the log says so.
"""

from __future__ import annotations

import functools
import logging

from torch import Tensor

from d2_plugin.compat import absolute, threedgs
from d2_plugin.compat.threedgs import GaussianRasterizationSettings
from d2_plugin.compiler import NoCompiler

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

log = logging.getLogger(__name__)


class GaussianRasterizer(threedgs.GaussianRasterizer):
    """As in 3DGS, and depth [1, H, W] = sum of w z with gradients."""

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
        if means2D_densify is not None and not _can_sum():
            means2D, means2D_densify = means2D + means2D_densify, None
        gaussians = (means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        drawn = self._draw(*gaussians, absolute=means2D_densify)
        return drawn.color, drawn.radii, drawn.depth


@functools.cache
def _can_sum() -> bool:
    """Whether absolute gradients are available; warns once where they are not."""
    try:
        absolute.library()
    except NoCompiler as error:
        log.warning(
            "means2D_densify receives signed gradients, so fewer Gaussians exceed densify_grad_threshold: %s", error
        )
        return False
    return True

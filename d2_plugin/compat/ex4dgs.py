"""`diff_gaussian_rasterization_df` of juno181/Ex4DGS: another blur, depth over alpha, and a flow that carries errors.

Footprints are blurred by `kernel_size`, and opacities are lowered by what the blur spreads (Mip-Splatting); Gaussians
are drawn between `min_depth` and `max_depth` and within 1.3 half images of the centre. The trainer registers a hook
on the flow that replaces its gradient by images of errors, whose sums per Gaussian then arrive at `dir3D`: no
gradient of the flow may therefore reach anything else, as in the original.

What differs: the gradients of depth and acc are the true ones (backward.cu:596 has a sign reversed, and the trainer
uses neither), and the index of the strongest Gaussian of each pixel, which the trainer never reads, is -1.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from d2_plugin.compat import inria
from d2_plugin.compat.inria import SETTINGS, GaussianRasterizationSettings, draw, view_of
from d2_plugin.protocol import Splats
from d2_plugin.rasterizer import rasterize

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

FRUSTUM = 1.3
"""Gaussians whose centre projects beyond this multiple of the half image are not drawn (auxiliary.h, in_frustum)."""


class GaussianRasterizer(inria.GaussianRasterizer):
    """As in 3DGS, with errors that come back through the flow."""

    def forward(  # type: ignore[override]  # `dir3D` stands before the opacities in the original
        self,
        means3D: Tensor,
        means2D: Tensor,
        dir3D: Tensor | None,
        opacities: Tensor,
        **others: Tensor | None,
    ) -> tuple[Tensor, ...]:
        """Color [3, H, W], radii [N] int32, depth [1, H, W], flow [3, H, W], acc [1, H, W] and indices [1, H, W]."""
        rows = torch.nonzero(self._in_frustum(means3D.detach())).squeeze(-1)
        splats, colors = self._chosen(rows, means3D, opacities, **others)
        return self._outputs(splats, colors, means2D, dir3D, len(means3D))

    def _outputs(
        self, splats: Splats, colors: Tensor, means2D: Tensor, dir3D: Tensor | None, count: int
    ) -> tuple[Tensor, ...]:
        settings = self.raster_settings
        constants = replace(
            SETTINGS, near=float(settings.min_depth), blur=float(settings.kernel_size), antialiased=True
        )
        drawn = draw(settings, splats, colors, settings.bg, means2D, count, constants=constants)
        weighed, acc = drawn.alpha > 0, drawn.alpha.clamp_min(torch.finfo(drawn.alpha.dtype).tiny)
        depth = torch.where(weighed, drawn.depth / acc, settings.max_depth)
        flow = drawn.color.new_zeros(3, settings.image_height, settings.image_width)
        if dir3D is not None:
            still = Splats(*(field.detach() for field in splats))
            sums = rasterize(still, dir3D[splats.rows], view_of(settings), constants).color.permute(2, 0, 1)
            flow = torch.where(weighed, sums / acc.detach(), 0.0).contiguous()
        no_index = torch.full_like(drawn.alpha, -1, dtype=torch.int32)
        return drawn.color, drawn.radii, depth, flow, drawn.alpha, no_index

    def _in_frustum(self, means: Tensor) -> Tensor:
        settings = self.raster_settings
        points = torch.cat([means, torch.ones_like(means[:, :1])], 1)
        depths = (points @ settings.viewmatrix.to(means))[:, 2]
        projected = points @ settings.projmatrix.to(means)
        screen = projected[:, :2] / (projected[:, 3:] + 1e-7)
        inside = (screen.abs() <= FRUSTUM).all(-1)
        return inside & (depths > settings.min_depth) & (depths <= settings.max_depth)

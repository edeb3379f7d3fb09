"""`diff_gaussian_rasterization` of graphdeco-inria/gaussian-splatting: color and radii."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from d2_plugin.compat.inria import Drawn, StandIn, colors_of, covariances_of, draw, exactly_one, given, shape_given
from d2_plugin.errors import D2Error
from d2_plugin.protocol import Splats


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
    debug: bool = False
    antialiasing: bool = False


class GaussianRasterizer(StandIn):
    """The original's module: construct it with settings for every image, call it with the Gaussians."""

    raster_settings: GaussianRasterizationSettings

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        if raster_settings.antialiasing:
            raise D2Error(
                "antialiasing needs the original rasterizer, this stand-in has none: switch it off or build it"
            )
        super().__init__(raster_settings)

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
        """Color [3, H, W] and radii [N] int32, with gradients to every tensor given."""
        drawn = self._draw(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        return drawn.color, drawn.radii

    def _draw(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None,
        colors_precomp: Tensor | None,
        scales: Tensor | None,
        rotations: Tensor | None,
        cov3D_precomp: Tensor | None,
        absolute: Tensor | None = None,
    ) -> Drawn:
        settings = self.raster_settings
        exactly_one("shs or colors_precomp", shs, colors_precomp)
        shape_given(scales, rotations, cov3D_precomp)
        if cov3D_precomp is None:
            shape = given(scales, "scales"), given(rotations, "rotations")
            cov3D_precomp = covariances_of(*shape, settings.scale_modifier)
        if colors_precomp is None:
            colors_precomp = colors_of(given(shs, "shs"), settings.sh_degree, means3D, settings.campos)
        rows = torch.arange(len(means3D), device=means3D.device)
        splats = Splats(means3D, cov3D_precomp, opacities.squeeze(-1), rows)
        return draw(settings, splats, colors_precomp, settings.bg, means2D, len(rows), absolute)

"""The rasterizer of fudan-zvg/4d-gaussian-splatting: 4D Gaussians sliced at a time, with depth, alpha and flow."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from d2_plugin.compat import inria
from d2_plugin.compat.inria import (
    GaussianRasterizationSettings,
    colors_of,
    covariances_of,
    draw,
    exactly_one,
    given,
    harmonics,
    shape_given,
)
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import covariances_from_factors, rotation_matrices_4d, time_row
from d2_plugin.gaussians.slicing import MARGINAL_CUT
from d2_plugin.protocol import Splats

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(inria.GaussianRasterizer):
    """As in 3DGS, for Gaussians that are sliced at the settings' timestamp."""

    def forward(  # type: ignore[override]  # other arguments, as in the original
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        flow_2d: Tensor | None = None,
        ts: Tensor | None = None,
        scales: Tensor | None = None,
        scales_t: Tensor | None = None,
        rotations: Tensor | None = None,
        rotations_r: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        prefilter_var: float = -1.0,
    ) -> tuple[Tensor, ...]:
        """Color [3, H, W], radii [N], depth [1, H, W], alpha [1, H, W], flow [2, H, W] and covariances [N, 6].

        `prefilter_var` is added to the temporal variance where it is positive. Covariances are 0 for Gaussians that
        are skipped at this time.
        """
        exactly_one("shs or colors_precomp", shs, colors_precomp)
        shape_given(scales, rotations, cov3D_precomp)
        if cov3D_precomp is not None:
            rows = torch.arange(len(means3D), device=means3D.device)
            splats = Splats(means3D, cov3D_precomp, opacities.squeeze(-1), rows)
        else:
            shape = (given(scales, "scales"), scales_t, given(rotations, "rotations"), rotations_r)
            splats = self._slice(means3D, opacities.squeeze(-1), ts, shape, prefilter_var)
        if colors_precomp is None:
            # From the unsliced centre, as the CUDA source does.
            colors = self._colors(given(shs, "shs"), means3D, ts, splats.rows)
        else:
            colors = colors_precomp[splats.rows]
        return self._outputs(splats, colors, flow_2d, means2D, len(means3D))

    def _slice(
        self,
        means: Tensor,
        opacities: Tensor,
        ts: Tensor | None,
        shape: tuple[Tensor, Tensor | None, Tensor, Tensor | None],
        prefilter: float,
    ) -> Splats:
        settings = self.raster_settings
        scales, scales_t, rotations, rotations_r = shape
        if settings.gaussian_dim != 4 and not settings.rot_4d:
            rows = torch.arange(len(means), device=means.device)
            return Splats(means, covariances_of(scales, rotations, settings.scale_modifier), opacities, rows)
        if ts is None or scales_t is None or (settings.rot_4d and rotations_r is None):
            raise D2Error("4D Gaussians need ts and scales_t, and rotations_r with rot_4d: pass all of them")
        offset = settings.timestamp - ts.squeeze(-1)
        if not settings.rot_4d:
            # The original takes scale_t for the variance here.
            variance = settings.scale_modifier * scales_t.squeeze(-1)
            rows, marginal = _alive(offset, variance, prefilter)
            covariances = covariances_of(scales[rows], rotations[rows], settings.scale_modifier)
            return Splats(means[rows], covariances, opacities[rows] * marginal, rows)
        left, right = rotations.T, given(rotations_r, "rotations_r").T
        deviations = settings.scale_modifier * torch.cat([scales, scales_t], -1).T
        variance = (time_row(left, right) * deviations).square().sum(0)
        rows, marginal = _alive(offset, variance, prefilter)
        factors = rotation_matrices_4d(left[:, rows], right[:, rows]) * deviations[:, rows]
        spatial, temporal = factors[:3], factors[3]
        velocity = (spatial * temporal).sum(1) / variance[rows]
        # A projected factor instead of the Schur complement of the covariance, which loses definiteness in float32.
        conditional = spatial - velocity[:, None] * temporal
        centres = means[rows] + (velocity * offset[rows]).T
        return Splats(centres, covariances_from_factors(conditional), opacities[rows] * marginal, rows)

    def _colors(self, shs: Tensor, means: Tensor, ts: Tensor | None, rows: Tensor) -> Tensor:
        """RGB [M, 3]; the cosines in time join at the full spatial degree only, as in computeColorFromSH_4D."""
        settings = self.raster_settings
        degree, centre = settings.sh_degree, settings.campos
        if settings.gaussian_dim == 3 or settings.force_sh_3d or degree < 3 or not settings.sh_degree_t:
            return colors_of(shs[rows], degree, means[rows], centre)
        values = harmonics(means[rows], centre, degree)
        phase = 2 * math.pi * (given(ts, "ts").squeeze(-1)[rows] - settings.timestamp) / settings.time_duration
        waves = torch.stack([torch.cos(n * phase) for n in range(settings.sh_degree_t + 1)], -1)
        products = (waves[:, :, None] * values[:, None]).flatten(1)
        return torch.relu((products[..., None] * shs[rows][:, : products.shape[1]]).sum(1) + 0.5)

    def _outputs(
        self, splats: Splats, colors: Tensor, flow_2d: Tensor | None, means2D: Tensor, count: int
    ) -> tuple[Tensor, ...]:
        settings, background = self.raster_settings, self.raster_settings.bg
        flowing = flow_2d is not None and (flow_2d.requires_grad or bool(flow_2d.any()))
        if flowing and flow_2d is not None:
            colors = torch.cat([colors, flow_2d[splats.rows]], -1)
            background = torch.cat([background, background.new_zeros(2)])
        drawn = draw(settings, splats, colors, background, means2D, count)
        flow = drawn.color[3:] if flowing else drawn.color.new_zeros(2, settings.image_height, settings.image_width)
        covariances = splats.covariances.new_zeros(count, 6).index_copy(0, splats.rows, splats.covariances)
        return drawn.color[:3], drawn.radii, drawn.depth, drawn.alpha, flow, covariances


def _alive(offset: Tensor, variance: Tensor, prefilter: float) -> tuple[Tensor, Tensor]:
    """Rows [M] that live at the time `offset` [N] away, and their temporal factor F [M]."""
    widened = variance + prefilter if prefilter > 0 else variance
    marginal = torch.exp(-0.5 * offset.square() / widened)
    rows = (marginal.detach() > MARGINAL_CUT).nonzero()[:, 0]
    return rows, marginal[rows]

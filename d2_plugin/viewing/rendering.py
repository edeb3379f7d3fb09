"""What a camera sees of a backbone: colour, depth, alpha, and the number of Gaussians over each pixel.

Everything here goes through the contract (`slice_at`, and `colors` where there is one), so any trainer with an adapter
can be shown. The trainer's own `render` is not called: it may keep state between two of the trainer's lines.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin.protocol import RasterSettings, Splats, View, call_optional
from d2_plugin.rasterizer import rasterize

SOLID = 0.5
"""A rendered depth is shown where the accumulated alpha exceeds this."""
GREY = 0.6
"""Brightness of Gaussians whose adapter knows no colours."""
MARKED = (1.0, 0.45, 0.0)
"""RGB of highlighted Gaussians."""
FADED = 0.3
"""Share of its brightness that a Gaussian keeps beside highlighted ones."""


class RenderedView(NamedTuple):
    """One view of a backbone, on the CPU."""

    color: Tensor  # [H, W, 3] in 0..1
    depth: Tensor  # [H, W] planar z, 0 where alpha is too low to have one
    alpha: Tensor  # [H, W] in 0..1
    splats: Splats
    """What was drawn, on the backbone's device."""


@torch.no_grad()
def render_view(backbone: Any, view: View, min_opacity: float = 0.0, marked: Tensor | None = None) -> RenderedView:
    """Draw one view of a `d2_plugin.protocol.Backbone`, without Gaussians whose opacity at that time is lower than
    `min_opacity`, and with the rows `marked`, bool [N], highlighted."""
    splats = backbone.slice_at(view)
    grey = splats.means.new_full((len(splats.means), 3), GREY)
    colors = backbone.colors(view, splats) if hasattr(backbone, "colors") else grey
    if min_opacity > 0:
        kept = torch.nonzero(splats.opacities >= min_opacity).squeeze(-1)
        splats, colors = Splats(*(part[kept] for part in splats)), colors[kept]
    if marked is not None:
        chosen = marked.to(splats.rows.device)[splats.rows][:, None]
        colors = torch.where(chosen, colors.new_tensor(MARKED), FADED * colors.mean(-1, keepdim=True))
    render = rasterize(splats, colors.contiguous(), view, backbone.settings)
    if marked is None:
        render = call_optional(backbone, "behind", render, view, default=render)
    color, depth_sum, alpha = (part.cpu() for part in render[:3])
    depth = torch.where(alpha > SOLID, depth_sum / alpha.clamp(min=SOLID), torch.zeros_like(alpha))
    return RenderedView(color.clamp(0, 1), depth, alpha, splats)


@torch.no_grad()
def gaussians_per_pixel(splats: Splats, view: View, settings: RasterSettings) -> Tensor:
    """In how many Gaussians' footprints each pixel lies, [H, W] float.

    A footprint is the axis-parallel box around the ellipse where alpha is at least `settings.alpha_min`: what a
    rasterizer has to walk through, whether or not something in front has used up the light.
    """
    T, K = view.T_camera_world.to(splats.means), view.K.to(splats.means)
    in_camera = splats.means @ T[:3, :3].T + T[:3, 3]
    drawn = (in_camera[:, 2] > settings.near) & (splats.opacities >= settings.alpha_min)
    x, y, z = in_camera[drawn].unbind(-1)
    zero = torch.zeros_like(z)
    slopes = torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2, zero, K[1, 1] / z, -K[1, 1] * y / z**2], -1)
    A = slopes.view(-1, 2, 3) @ T[:3, :3]
    whole = splats.covariances[drawn][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    variances = (A @ whole @ A.transpose(1, 2)).diagonal(dim1=1, dim2=2) + settings.blur
    reach = (2 * torch.log(splats.opacities[drawn] / settings.alpha_min)).clamp(min=0)[:, None]
    half = (reach * variances).sqrt()
    centre = torch.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], -1)
    return _boxes_over_pixels(centre - half, centre + half, view.width, view.height)


def _boxes_over_pixels(low: Tensor, high: Tensor, width: int, height: int) -> Tensor:
    """How many of the boxes [M, 2] hold each pixel's centre: corners are counted, then summed along both axes."""
    size = low.new_tensor([width, height])
    fine = torch.isfinite(low).all(-1) & torch.isfinite(high).all(-1)
    first = (low[fine] - 0.5).ceil().clamp(min=0).minimum(size).long()
    last = (high[fine] + 0.5).floor().clamp(min=0).minimum(size).long()  # one beyond the last pixel inside
    last = torch.maximum(first, last)
    count = low.new_zeros(height + 1, width + 1)
    for x, y, sign in ((first, first, 1.0), (last, last, 1.0), (first, last, -1.0), (last, first, -1.0)):
        count.index_put_((y[:, 1], x[:, 0]), count.new_tensor(sign), accumulate=True)
    return count.cumsum(0).cumsum(1)[:height, :width].cpu()

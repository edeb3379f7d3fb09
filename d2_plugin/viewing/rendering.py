"""What a camera sees of a backbone: colour, depth and alpha.

Everything here goes through the contract (`slice_at`, and `colors` where there is one), so any trainer with an adapter
can be shown. The trainer's own `render` is not called: it may keep state between two of the trainer's lines.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin.hooks.densify import rendered_depth
from d2_plugin.protocol import Splats, View, call_optional
from d2_plugin.rasterizer import rasterize
from d2_plugin.runs.evaluation import RENDERED_ALPHA

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
def render_view(backbone: Any, view: View, marked: Tensor | None = None, scale: float = 1.0) -> RenderedView:
    """Draw one view of a `d2_plugin.protocol.Backbone`, with the rows `marked`, bool [N], highlighted.

    `scale` is the number of its pixels that lie along one of the recording's: the blur of training is of those, and
    what is thinner would be a hairline in a finer image."""
    splats = backbone.slice_at(view)
    grey = splats.means.new_full((len(splats.means), 3), GREY)
    colors = backbone.colors(view, splats) if hasattr(backbone, "colors") else grey
    if marked is not None:
        chosen = marked.to(splats.rows.device)[splats.rows][:, None]
        colors = torch.where(chosen, colors.new_tensor(MARKED), FADED * colors.mean(-1, keepdim=True))
    settings = replace(backbone.settings, blur=backbone.settings.blur * max(scale, 1.0) ** 2)
    render = rasterize(splats, colors.contiguous(), view, settings)
    if marked is None:
        render = call_optional(backbone, "behind", render, view, default=render)
    color, depth_sum, alpha = (part.cpu() for part in render[:3])
    return RenderedView(color.clamp(0, 1), rendered_depth(depth_sum, alpha, RENDERED_ALPHA)[0], alpha, splats)

"""What the depth prior says to the rasterizer: how much a pixel counts, and which space is free."""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, View


def reliability(prior: DepthPrior) -> Tensor:
    """r(p) [H, W]: how much D* counts at each pixel.

    A prior without such a map has 1 where it is trusted and 0 elsewhere. Far pixels always have 0, since their depth is
    a lower bound and judges nothing.
    """
    if prior.reliability is None:
        return prior.trusted.to(torch.float32)
    return torch.where(prior.far, 0.0, prior.reliability)


def check_maps(view: View, prior: DepthPrior | None, near_edge: Tensor | None) -> None:
    """Refuse maps of another size than the view's.

    Raises:
        D2Error: a map is not [H, W], or the near edge holds no floating-point numbers.
    """
    maps = {} if prior is None else {"depth": prior.depth, "labels": prior.labels, "reliability": prior.reliability}
    size = (view.height, view.width)
    for name, part in maps.items():
        if part is not None and part.shape != size:
            raise D2Error(
                f"the prior of camera '{view.camera}' has {name} {tuple(part.shape)} but the view is {size}: "
                "resample it to the view's height and width"
            )
    if near_edge is not None and near_edge.shape != size:
        raise D2Error(f"near_edge has shape {tuple(near_edge.shape)}, expected {size} as the view has pixels")
    if near_edge is not None and not near_edge.is_floating_point():
        raise D2Error(f"near_edge is {near_edge.dtype}, expected floating-point depths: convert it")

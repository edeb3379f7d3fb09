"""Whether a trainer's own render can replace ours: its depth and alpha need gradients and the same meaning.

Depth is the sum of w z in most rasterizers, but divided by alpha in Ex4DGS, the median in SpacetimeGaussians, and
without a gradient in the main branch of depth-diff-gaussian-rasterization. A render package does not say which of these
it holds, so one render is compared with our own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin.protocol import Render

AGREEMENT = 0.02
"""Largest relative difference, in the median over covered pixels, at which two renders mean the same."""

COVERED = 0.5
"""Alpha above which a pixel is compared."""


class Probe(NamedTuple):
    """The verdict on one render: `usable`, the sentence for the log, and whether there was enough to judge by."""

    usable: bool
    sentence: str
    final: bool = True


def probe_package(package: Mapping[str, Any], own: Render, parameters: Sequence[Tensor]) -> Probe:
    """Judge a render package (keys `depth` and `alpha`) of the view that `own` shows.

    `parameters` are positions and opacities of the Gaussians, to which depth and alpha must have gradients that are not
    all zero; they are computed separately, and `.grad` is not touched.
    """
    missing = [name for name in ("depth", "alpha") if not isinstance(package.get(name), Tensor)]
    if missing:
        return _own_path(f"has no {' and no '.join(missing)}")
    depth, alpha = package["depth"], package["alpha"]
    size = own.alpha.numel()
    if depth.numel() != size or alpha.numel() != size:
        return _own_path(f"has a depth of shape {tuple(depth.shape)} for a view of {tuple(own.alpha.shape)}")
    for name, output in (("depth", depth), ("alpha", alpha)):
        if not _has_gradient(output, parameters):
            return _own_path(f"has a {name} without a gradient to the Gaussians")
    return _compared(depth.detach().reshape(own.alpha.shape), alpha.detach().reshape(own.alpha.shape), own)


def _compared(depth: Tensor, alpha: Tensor, own: Render) -> Probe:
    own = Render(*(output.detach() for output in own[:3]))
    covered = (own.alpha > COVERED) & (alpha > COVERED)
    if not covered.any():
        return _own_path("covers no pixel yet, so its depth could not be compared")._replace(final=False)
    if _difference(alpha[covered], own.alpha[covered]) > AGREEMENT:
        return _own_path("has an alpha that is not the sum of the weights")
    if _difference(depth[covered], own.depth_sum[covered]) > AGREEMENT:
        normalised = _difference(depth[covered], (own.depth_sum / own.alpha)[covered]) <= AGREEMENT
        return _own_path("has a depth that " + ("is divided by alpha" if normalised else "is not the sum of w z"))
    return Probe(True, "the trainer's own render has depth and alpha with gradients: D2 uses it, no second render")


def _difference(values: Tensor, reference: Tensor) -> float:
    return float(((values - reference).abs() / reference.abs().clamp_min(1e-12)).median())


def _has_gradient(output: Tensor, parameters: Sequence[Tensor]) -> bool:
    if not output.requires_grad:
        return False
    with torch.enable_grad():
        gradients = torch.autograd.grad(output.sum(), parameters, retain_graph=True, allow_unused=True)
    return all(gradient is not None and bool(gradient.any()) for gradient in gradients)


def _own_path(flaw: str) -> Probe:
    return Probe(False, f"the trainer's own render {flaw}: D2 renders depth with its own rasterizer")

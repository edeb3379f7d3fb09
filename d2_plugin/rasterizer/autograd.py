"""The kernels of `native` and `cuda` as functions that torch differentiates, once; float32.

`torch.compile` breaks its graph here: there is nothing in a kernel that it could fuse.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.protocol import DepthPrior, RasterSettings, Render, Splats, Survey, View
from d2_plugin.rasterizer import native
from d2_plugin.rasterizer.reference import reliability

INPUTS = 9
"""Tensors that the kernels take: 6 of the Gaussians and what they are drawn on, 2 of the camera, the near edge."""


def rasterize(
    splats: Splats,
    colors: Tensor,
    view: View,
    settings: RasterSettings,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    near_edge: Tensor | None = None,
) -> Render:
    """See `d2_plugin.rasterizer.rasterize`."""
    color, depth_sum, alpha, front = _Rasterize.apply(
        *(part.contiguous() for part in splats[:3]),
        colors.contiguous(),
        None if background is None else background.contiguous(),
        None if screen_offsets is None else screen_offsets.contiguous(),
        view.T_camera_world,
        view.K,
        _map(near_edge, splats.means),
        view.width,
        view.height,
        constants_of(settings),
    )
    return Render(color, depth_sum, alpha, None if near_edge is None else front)


def survey(
    splats: Splats,
    view: View,
    prior: DepthPrior,
    settings: RasterSettings,
    eps: float,
    near_edge: Tensor | None = None,
) -> Survey:
    """See `d2_plugin.rasterizer.survey`."""
    means, covariances, opacities = (part.contiguous() for part in splats[:3])
    depth, counted, edge = (_map(part, means) for part in (prior.depth, reliability(prior), near_edge))
    kernels = _kernels(means)
    camera = (view.T_camera_world, view.K, view.width, view.height)
    frame = kernels.frame_of(means, covariances, opacities, camera, constants_of(settings), 0)
    frame.pointing(prior_depth=depth, reliability=counted, near_edge=edge).eps = eps
    kernels.project(frame, means, view.K)
    weight, error, max_weight, front = (torch.empty_like(opacities) for _ in range(4))
    hits = torch.empty_like(opacities, dtype=torch.int32)
    depth_sum, alpha = (opacities.new_empty(view.height, view.width) for _ in range(2))
    frame.pointing(depth_sum=depth_sum, alpha=alpha, hits=hits)
    kernels.gather(frame.pointing(weight=weight, error=error, max_weight=max_weight, front_weight=front), means.device)
    return Survey(weight, error, max_weight, hits, depth_sum, alpha, front)


@functools.lru_cache(maxsize=64)
def constants_of(settings: RasterSettings) -> list[float]:
    """In the order of d2::Constants (kernels/splat.h), which is that of the dataclass."""
    return [float(value) for value in dataclasses.astuple(settings)]


def _map(part: Tensor | None, like: Tensor) -> Tensor | None:
    """A map of the prior as the kernels read it: in the dtype and on the device of `like`."""
    return None if part is None else part.detach().to(like).contiguous()


def _kernels(part: Tensor) -> ModuleType:
    if not part.is_cuda:
        return native
    from d2_plugin.rasterizer import cuda  # a trainer on the CPU loads none of it

    return cuda


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, width, height, ctx.constants = inputs
        means, colors, K, near_edge = tensors[0], tensors[3], tensors[7], tensors[8]
        kernels, frame = _frame(tensors, width, height, ctx.constants)
        records, lists = kernels.project(frame, means, K)
        color = means.new_empty(height, width, colors.shape[1])
        depth_sum, alpha = (means.new_empty(height, width) for _ in range(2))
        front = means.new_empty((0,) if near_edge is None else (height, width))
        kernels.render(frame.pointing(color=color, depth_sum=depth_sum, alpha=alpha, front=front), means.device)
        ctx.save_for_backward(*tensors, color, depth_sum, alpha, front, records, lists)
        ctx.set_materialize_grads(False)
        return color, depth_sum, alpha, front

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors[:INPUTS]
        color, depth_sum, alpha, front, records, lists = ctx.saved_tensors[INPUTS:]
        means, covariances, opacities, colors = inputs[:4]
        kernels, frame = _frame(inputs, color.shape[1], color.shape[0], ctx.constants)
        frame.pointing(color=color, depth_sum=depth_sum, alpha=alpha, front=front, records=records)
        kernels.point_lists(frame, lists)
        upstream = [None if gradient is None else gradient.contiguous() for gradient in gradients]
        frame.pointing(**dict(zip(("grad_color", "grad_depth_sum", "grad_alpha", "grad_front"), upstream)))
        computed: list[Tensor | None] = [torch.empty_like(part) for part in (means, covariances, opacities, colors)]
        on_screen = means.new_empty(len(means), 2)
        names = ("grad_means", "grad_covariances", "grad_opacities", "grad_colors")
        frame.pointing(**dict(zip(names, computed)), grad_screen_offsets=on_screen)
        kernels.backward(frame, means.device)
        on_background = None
        if ctx.needs_input_grad[4] and upstream[0] is not None:
            on_background = ((1 - alpha)[..., None] * upstream[0]).sum((0, 1))
        computed += [on_background, on_screen]
        wanted = (gradient if asked else None for gradient, asked in zip(computed, ctx.needs_input_grad))
        return (*wanted, *(None for _ in range(len(ctx.needs_input_grad) - len(computed))))


def _frame(inputs: Sequence[Tensor], width: int, height: int, constants: list[float]) -> tuple[ModuleType, Any]:
    means, covariances, opacities, colors, background, screen_offsets, *camera, near_edge = inputs
    kernels = _kernels(means)
    frame = kernels.frame_of(means, covariances, opacities, (*camera, width, height), constants, colors.shape[1])
    return kernels, frame.pointing(
        colors=colors, background=background, screen_offsets=screen_offsets, near_edge=near_edge
    )

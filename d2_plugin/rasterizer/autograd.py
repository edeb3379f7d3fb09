"""The kernels of `native` and `cuda` as functions that torch differentiates, once; float32.

`torch.compile` breaks its graph here: there is nothing in a kernel that it could fuse.
"""

from __future__ import annotations

import dataclasses
import functools
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
    color, depth_sum, alpha, front, *_ = _Rasterize.apply(
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
    maps = (_map(part, splats.means) for part in (prior.depth, reliability(prior), near_edge))
    parts = (part.contiguous() for part in splats[:3])
    return _kernels(splats.means).survey(*parts, *maps, view.T_camera_world, view.K, constants_of(settings), eps)


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
        outputs: tuple[Tensor, ...] = _kernels(inputs[0]).rasterize(*inputs)
        *tensors, _, _, ctx.constants = inputs
        ctx.save_for_backward(*tensors, *outputs)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*outputs[4:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs, outputs = ctx.saved_tensors[:INPUTS], ctx.saved_tensors[INPUTS:]
        upstream = [None if gradient is None else gradient.contiguous() for gradient in gradients[:4]]
        computed = _kernels(outputs[0]).backward(*upstream, *inputs, ctx.constants, *outputs)
        wanted = (gradient if asked else None for gradient, asked in zip(computed, ctx.needs_input_grad))
        return (*wanted, *(None for _ in range(len(ctx.needs_input_grad) - len(computed))))

"""The kernels as torch operators: `torch.ops.d2.rasterize`, `rasterize_backward` and `survey`.

Registered with fake and autograd implementations, so that torch.compile and friends see through them. A device has
them where it registers its kernels here; `d2_plugin.rasterizer` falls back to `reference` elsewhere.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from d2_plugin.protocol import DepthPrior, RasterSettings, Render, Splats, Survey, View

from . import cuda, native
from .frame import RECORD

_CAMERA = "Tensor T_camera_world, Tensor K"
_SPLATS = "Tensor means, Tensor covariances, Tensor opacities"
_INPUTS = f"{_SPLATS}, Tensor colors, Tensor? background, Tensor? screen_offsets"


def rasterize(
    splats: Splats,
    colors: Tensor,
    view: View,
    settings: RasterSettings,
    background: Tensor | None,
    screen_offsets: Tensor | None,
) -> Render:
    """See `d2_plugin.rasterizer.rasterize`; float32."""
    outputs = _rasterize(
        *(part.contiguous() for part in splats[:3]),
        colors.contiguous(),
        None if background is None else background.contiguous(),
        None if screen_offsets is None else screen_offsets.contiguous(),
        view.T_camera_world,
        view.K,
        view.width,
        view.height,
        _constants(settings),
    )
    return Render(*outputs[:3])


def survey(splats: Splats, view: View, prior: DepthPrior, settings: RasterSettings, eps: float) -> Survey:
    """See `d2_plugin.rasterizer.survey`; float32."""
    means, covariances, opacities, _ = splats
    depth, trusted = prior.depth.to(means).contiguous(), prior.trusted.to(means.device).contiguous()
    camera = (view.T_camera_world, view.K)
    parts = (means.contiguous(), covariances.contiguous(), opacities.contiguous())
    return Survey(*_survey(*parts, depth, trusted, *camera, _constants(settings), eps))


def _constants(settings: RasterSettings) -> list[float]:
    """In the order of d2::Constants (kernels/splat.h), which is that of the dataclass."""
    return list(dataclasses.astuple(settings))


_rasterize = torch.library.custom_op(
    "d2::rasterize",
    native.rasterize,
    mutates_args=(),
    device_types="cpu",
    schema=f"({_INPUTS}, {_CAMERA}, int width, int height, float[] constants) -> "
    "(Tensor color, Tensor depth_sum, Tensor alpha, Tensor records, Tensor lists)",
)

_rasterize_backward = torch.library.custom_op(
    "d2::rasterize_backward",
    native.backward,
    mutates_args=(),
    device_types="cpu",
    schema=f"(Tensor? grad_color, Tensor? grad_depth_sum, Tensor? grad_alpha, {_INPUTS}, {_CAMERA}, float[] constants, "
    "Tensor color, Tensor depth_sum, Tensor alpha, Tensor records, Tensor lists) -> "
    "(Tensor means, Tensor covariances, Tensor opacities, Tensor colors, Tensor background, Tensor screen_offsets)",
)

_survey = torch.library.custom_op(
    "d2::survey",
    native.survey,
    mutates_args=(),
    device_types="cpu",
    schema=f"({_SPLATS}, Tensor prior_depth, Tensor trusted, {_CAMERA}, float[] constants, float eps) -> "
    "(Tensor weight, Tensor error, Tensor max_weight, Tensor hits, Tensor depth_sum, Tensor alpha)",
)

for _operator, _kernel in ((_rasterize, cuda.rasterize), (_rasterize_backward, cuda.backward), (_survey, cuda.survey)):
    _operator.register_kernel("cuda")(_kernel)


@_rasterize.register_fake
def _(means, covariances, opacities, colors, background, screen_offsets, T_camera_world, K, width, height, constants):  # type: ignore[no-untyped-def]
    pairs = torch.library.get_ctx().new_dynamic_size()
    return (
        means.new_empty(height, width, colors.shape[1]),
        means.new_empty(height, width),
        means.new_empty(height, width),
        means.new_empty(means.shape[0], RECORD),
        means.new_empty(pairs, dtype=torch.int32),
    )


@_rasterize_backward.register_fake
def _(grad_color, grad_depth_sum, grad_alpha, means, covariances, opacities, colors, *rest):  # type: ignore[no-untyped-def]
    gradients = [torch.empty_like(part) for part in (means, covariances, opacities, colors)]
    return (*gradients, means.new_empty(colors.shape[1]), means.new_empty(means.shape[0], 2))


@_survey.register_fake
def _(means, covariances, opacities, prior_depth, trusted, T_camera_world, K, constants, eps):  # type: ignore[no-untyped-def]
    hits = opacities.new_empty(opacities.shape, dtype=torch.int32)
    image = torch.empty_like(prior_depth)
    return *(torch.empty_like(opacities) for _ in range(3)), hits, image, torch.empty_like(image)


def _save(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    *tensors, _, _, ctx.constants = inputs
    ctx.save_for_backward(*tensors, *output)
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    means, covariances, opacities, colors, background, screen_offsets, *rest = ctx.saved_tensors
    inputs = (means, covariances, opacities, colors, background, screen_offsets)
    camera, outputs = rest[:2], rest[2:]
    upstream = [None if gradient is None else gradient.contiguous() for gradient in gradients[:3]]
    found = _rasterize_backward(*upstream, *inputs, *camera, ctx.constants, *outputs)
    wanted = (gradient if asked else None for gradient, asked in zip(found, ctx.needs_input_grad))
    return (*wanted, None, None, None, None, None)


_rasterize.register_autograd(_backward, setup_context=_save)

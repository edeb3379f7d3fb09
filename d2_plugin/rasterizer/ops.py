"""The kernels as torch operators: `torch.ops.d2.rasterize`, `rasterize_backward` and `survey`.

Registered with fake and autograd implementations, so that torch.compile and friends see through them. A device has
them where it registers its kernels here; `d2_plugin.rasterizer` falls back to `reference` elsewhere.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.protocol import DepthPrior, RasterSettings, Render, Splats, Survey, View
from d2_plugin.rasterizer import cuda, native
from d2_plugin.rasterizer.evidence import reliability
from d2_plugin.rasterizer.frame import RECORD
from d2_plugin.rasterizer.operator import custom_op

INPUTS = 9
"""Tensors that `rasterize` takes: 6 of the Gaussians and what they are drawn on, 2 of the camera, the near edge."""

_CAMERA = "Tensor T_camera_world, Tensor K"
_SPLATS = "Tensor means, Tensor covariances, Tensor opacities"
_INPUTS = f"{_SPLATS}, Tensor colors, Tensor? background, Tensor? screen_offsets, {_CAMERA}, Tensor? near_edge"
_IMAGES = "Tensor color, Tensor depth_sum, Tensor alpha, Tensor front"
_STATE = "Tensor records, Tensor lists"
_UPSTREAM = "Tensor? grad_color, Tensor? grad_depth_sum, Tensor? grad_alpha, Tensor? grad_front"


def rasterize(
    splats: Splats,
    colors: Tensor,
    view: View,
    settings: RasterSettings,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    near_edge: Tensor | None = None,
) -> Render:
    """See `d2_plugin.rasterizer.rasterize`; float32."""
    run = _Rasterize.apply if _is_plain(splats.means) else _rasterize
    color, depth_sum, alpha, front, *_ = run(
        *(part.contiguous() for part in splats[:3]),
        colors.contiguous(),
        None if background is None else background.contiguous(),
        None if screen_offsets is None else screen_offsets.contiguous(),
        view.T_camera_world,
        view.K,
        _map(near_edge, splats.means),
        view.width,
        view.height,
        _constants(settings) if run is _rasterize else _known_constants(settings),
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
    """See `d2_plugin.rasterizer.survey`; float32."""
    means, covariances, opacities, _ = splats
    maps = (_map(part, means) for part in (prior.depth, reliability(prior), near_edge))
    parts = (means.contiguous(), covariances.contiguous(), opacities.contiguous())
    return Survey(*_survey(*parts, *maps, view.T_camera_world, view.K, _constants(settings), eps))


def _map(part: Tensor | None, like: Tensor) -> Tensor | None:
    """A map of the prior as the kernels read it: in the dtype and on the device of `like`."""
    return None if part is None else part.detach().to(like).contiguous()


def _constants(settings: RasterSettings) -> list[float]:
    """In the order of d2::Constants (kernels/splat.h), which is that of the dataclass."""
    return [float(value) for value in dataclasses.astuple(settings)]


_known_constants = functools.lru_cache(maxsize=64)(_constants)


_rasterize = custom_op(
    "d2::rasterize",
    native.rasterize,
    mutates_args=(),
    device_types="cpu",
    schema=f"({_INPUTS}, int width, int height, float[] constants) -> ({_IMAGES}, {_STATE})",
)

_rasterize_backward = custom_op(
    "d2::rasterize_backward",
    native.backward,
    mutates_args=(),
    device_types="cpu",
    schema=f"({_UPSTREAM}, {_INPUTS}, float[] constants, {_IMAGES}, {_STATE}) -> "
    "(Tensor means, Tensor covariances, Tensor opacities, Tensor colors, Tensor background, Tensor screen_offsets)",
)

_survey = custom_op(
    "d2::survey",
    native.survey,
    mutates_args=(),
    device_types="cpu",
    schema=f"({_SPLATS}, Tensor prior_depth, Tensor reliability, Tensor? near_edge, {_CAMERA}, float[] constants, "
    "float eps) -> (Tensor weight, Tensor error, Tensor max_weight, Tensor hits, Tensor depth_sum, Tensor alpha, "
    "Tensor front)",
)

for _operator, _kernel in ((_rasterize, cuda.rasterize), (_rasterize_backward, cuda.backward), (_survey, cuda.survey)):
    _operator.register_kernel("cuda")(_kernel)


@_rasterize.register_fake
def _(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    near_edge: Tensor | None,
    width: int,
    height: int,
    constants: list[float],
) -> tuple[Tensor, ...]:
    pairs = torch.library.get_ctx().new_dynamic_size()
    color = means.new_empty(height, width, colors.shape[1])
    depth_sum, alpha = means.new_empty(height, width), means.new_empty(height, width)
    front = means.new_empty((0,) if near_edge is None else (height, width))
    return (
        color,
        depth_sum,
        alpha,
        front,
        means.new_empty(means.shape[0], RECORD),
        means.new_empty(pairs, dtype=torch.int32),
    )


@_rasterize_backward.register_fake
def _(
    grad_color: Tensor | None,
    grad_depth_sum: Tensor | None,
    grad_alpha: Tensor | None,
    grad_front: Tensor | None,
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    *rest: object,
) -> tuple[Tensor, ...]:
    gradients = [torch.empty_like(part) for part in (means, covariances, opacities, colors)]
    return (*gradients, means.new_empty(colors.shape[1]), means.new_empty(means.shape[0], 2))


@_survey.register_fake
def _(means: Tensor, covariances: Tensor, opacities: Tensor, prior_depth: Tensor, *rest: object) -> tuple[Tensor, ...]:
    weight, error, max_weight, front = (torch.empty_like(opacities) for _ in range(4))
    hits = opacities.new_empty(opacities.shape, dtype=torch.int32)
    return weight, error, max_weight, hits, torch.empty_like(prior_depth), torch.empty_like(prior_depth), front


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, _, _, ctx.constants = inputs
    ctx.save_for_backward(*tensors, *output)
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    inputs, outputs = ctx.saved_tensors[:INPUTS], ctx.saved_tensors[INPUTS:]
    upstream = [None if gradient is None else gradient.contiguous() for gradient in gradients[:4]]
    run = _rasterize_backward
    if _is_plain(outputs[0]):
        run = cuda.backward if outputs[0].is_cuda else native.backward
    found = run(*upstream, *inputs, ctx.constants, *outputs)
    wanted = (gradient if asked else None for gradient, asked in zip(found, ctx.needs_input_grad))
    return (*wanted, *(None for _ in range(len(ctx.needs_input_grad) - len(found))))


_rasterize.register_autograd(_backward, setup_context=_save)


class _Rasterize(torch.autograd.Function):
    """The operator without the dispatcher, whose way from Python to Python costs more than small images do."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        kernels = cuda if inputs[0].is_cuda else native
        outputs = kernels.rasterize(*inputs)
        _save(ctx, inputs, outputs)
        ctx.mark_non_differentiable(*outputs[4:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        return _backward(ctx, *gradients)


def _is_plain(part: Tensor) -> bool:
    """Whether nobody looks on who needs the operator: no compilation, no fake tensors, no transform of functions."""
    if torch.compiler.is_compiling() or type(part) not in (Tensor, torch.nn.Parameter):
        return False
    return not (torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack())

"""The depth loss of one view with its gradient, in `kernels/depth_loss.cpp`.

In torch a training step of 50,000 Gaussians at 640x360 takes half as long again. Compiled at first use; runs on
`torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler.kernels import load_kernel, structure
from d2_plugin.hooks.prior import KnownMaps
from d2_plugin.rasterizer.native import KERNELS as RASTERIZER_KERNELS

SOURCE = Path(__file__).parent / "kernels" / "depth_loss.cpp"
HEADERS = (RASTERIZER_KERNELS / "parallel.h", RASTERIZER_KERNELS / "simd.h")
FLAGS = ("-ffp-contract=fast",)


_Call = structure(
    "long pixels",
    "int threads",
    "float tau_v sigma_full epsilon",
    "double opaque factor",
    "pointer kind depth sigma depth_sum alpha grad_depth_sum grad_alpha",
)
"""d2::DepthLoss of kernels/depth_loss.cpp; null gradients are not computed."""


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler. Raises CompileError as `d2_plugin.compiler.kernels.load_kernel`."""
    results = {"d2_depth_loss": ctypes.c_double}
    return load_kernel("depth_loss", (SOURCE,), HEADERS, FLAGS, {"depth_loss": _Call}, results, optional=True)


def can_compare(depth_sum: Tensor, alpha: Tensor, known: KnownMaps) -> bool:
    """Whether the kernel takes these: float32 on the CPU, and there is a compiler."""
    parts = (depth_sum, alpha, known.depth) + ((known.sigma,) if known.sigma is not None else ())
    return all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts) and library() is not None


def native_depth_loss(depth_sum: Tensor, alpha: Tensor, known: KnownMaps, constants: tuple[float, ...]) -> Tensor:
    """See `depth_loss.supervision`; differentiable once by `depth_sum` and `alpha`, [H, W] as the maps are.

    `constants` are tau_v, sigma_full, epsilon and opaque of `DepthLossConfig`, and the factor of the result. Gradients
    are computed along with the value, factor included: the upstream gradient is then 1, and nothing is left to do.
    """
    if not torch.is_grad_enabled():
        depth_sum, alpha = depth_sum.detach(), alpha.detach()
    return _DepthLoss.apply(depth_sum, alpha, known, constants)


class _DepthLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth_sum: Tensor, alpha: Tensor, known: KnownMaps, constants: tuple[float, ...]) -> Tensor:
        kernel = library()
        assert kernel is not None, "native_depth_loss is for where can_compare is True"
        assert depth_sum.shape == alpha.shape == known.kind.shape, "the loader refuses priors of another size"
        depth_sum, alpha, kind, depth = (part.contiguous() for part in (depth_sum, alpha, known.kind, known.depth))
        sigma = None if known.sigma is None else known.sigma.contiguous()
        tau_v, sigma_full, epsilon, opaque, factor = constants
        call = _Call(depth_sum.numel(), torch.get_num_threads(), tau_v, sigma_full, epsilon)
        call.opaque, call.factor = opaque / max(known.near, 1), factor
        call.point(kind=kind, depth=depth, sigma=sigma, depth_sum=depth_sum, alpha=alpha)
        if any(ctx.needs_input_grad[:2]):
            by_depth_sum, by_alpha = torch.empty_like(depth_sum), torch.empty_like(alpha)
            call.point(grad_depth_sum=by_depth_sum, grad_alpha=by_alpha)
            ctx.save_for_backward(by_depth_sum, by_alpha)
        return depth_sum.new_full((), kernel.d2_depth_loss(call))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        by_depth_sum, by_alpha = ctx.saved_tensors
        if upstream.item() != 1:
            by_depth_sum, by_alpha = by_depth_sum * upstream, by_alpha * upstream
        return by_depth_sum, by_alpha, None, None

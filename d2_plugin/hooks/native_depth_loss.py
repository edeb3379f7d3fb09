"""The depth loss at the known pixels with its gradient, in `kernels/depth_loss.cpp`.

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.hooks.prior import KnownPixels
from d2_plugin.rasterizer.frame import KERNELS as RASTERIZER_KERNELS

SOURCE = Path(__file__).parent / "kernels" / "depth_loss.cpp"
HEADERS = (RASTERIZER_KERNELS / "parallel.h", RASTERIZER_KERNELS / "simd.h")
FLAGS = ("-ffp-contract=fast",)


class Constants(NamedTuple):
    """See `DepthLossConfig`; `factor` is what all of it is multiplied by."""

    tau_v: float
    sigma_full: float
    epsilon: float
    opaque: float
    factor: float


class _Call(ctypes.Structure):
    """d2::DepthLoss of kernels/depth_loss.cpp; null gradients are not computed."""

    _fields_ = (
        ("pixels", ctypes.c_int64),
        ("threads", ctypes.c_int32),
        *((name, ctypes.c_float) for name in ("tau_v", "sigma_full", "epsilon")),
        *((name, ctypes.c_double) for name in ("opaque", "factor")),
        *((name, ctypes.c_void_p) for name in ("kind", "depth", "sigma", "depth_sum", "alpha")),
        *((name, ctypes.c_void_p) for name in ("grad_depth_sum", "grad_alpha")),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler, of which the rasterizer has warned already.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("depth_loss", (SOURCE,), HEADERS, FLAGS)
    except NoCompiler:
        return None
    call = (ctypes.POINTER(_Call),)
    kernel.d2_depth_loss.argtypes, kernel.d2_depth_loss.restype = call, ctypes.c_double
    kernel.d2_depth_loss_size.restype = ctypes.c_int64
    size = kernel.d2_depth_loss_size()
    assert size == ctypes.sizeof(_Call), "the call differs between native_depth_loss.py and depth_loss.cpp"
    return kernel


def can_compare(depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels) -> bool:
    """Whether the kernel takes these: float32 on the CPU, some known pixels, and there is a compiler."""
    if pixels.count == 0 or depth_sum.shape != alpha.shape:
        return False
    maps = pixels.maps(depth_sum.numel())
    parts = (depth_sum, alpha, maps.depth) + ((maps.sigma,) if maps.sigma is not None else ())
    return all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts) and library() is not None


def native_depth_loss(depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, constants: Constants) -> Tensor:
    """See `depth_loss.pixel_depth_loss`; differentiable once by `depth_sum` and `alpha`.

    Gradients are made along with the value, `factor` in them: what comes back is then 1, and nothing is left to do.
    """
    if not torch.is_grad_enabled():
        depth_sum, alpha = depth_sum.detach(), alpha.detach()
    return _DepthLoss.apply(depth_sum, alpha, pixels, constants)


class _DepthLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, constants: Constants) -> Tensor:
        kernel = library()
        assert kernel is not None, "native_depth_loss is for where can_compare is True"
        depth_sum, alpha = depth_sum.contiguous(), alpha.contiguous()
        maps = pixels.maps(depth_sum.numel())
        constants = constants._replace(opaque=constants.opaque / max(pixels.near, 1))
        call = _Call(depth_sum.numel(), torch.get_num_threads(), *constants)
        call.kind, call.depth, call.depth_sum = maps.kind.data_ptr(), maps.depth.data_ptr(), depth_sum.data_ptr()
        call.sigma, call.alpha = None if maps.sigma is None else maps.sigma.data_ptr(), alpha.data_ptr()
        if any(ctx.needs_input_grad[:2]):
            found = torch.empty_like(depth_sum), torch.empty_like(alpha)
            call.grad_depth_sum, call.grad_alpha = (part.data_ptr() for part in found)
            ctx.save_for_backward(*found)
        return depth_sum.new_full((), kernel.d2_depth_loss(call))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        by_depth_sum, by_alpha = ctx.saved_tensors
        if upstream.item() != 1:
            by_depth_sum, by_alpha = by_depth_sum * upstream, by_alpha * upstream
        return by_depth_sum, by_alpha, None, None

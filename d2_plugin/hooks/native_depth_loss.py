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
from d2_plugin.rasterizer.frame import KERNELS as RASTERIZER_KERNELS

from .prior import KnownPixels

SOURCE = Path(__file__).parent / "kernels" / "depth_loss.cpp"
HEADERS = (RASTERIZER_KERNELS / "parallel.h",)
FLAGS = ("-ffp-contract=fast",)


class Constants(NamedTuple):
    """See `DepthLossConfig`."""

    tau_v: float
    sigma_full: float
    epsilon: float
    opaque: float


class _Call(ctypes.Structure):
    """d2::DepthLoss of kernels/depth_loss.cpp."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("known", "pixels")),
        ("threads", ctypes.c_int32),
        *((name, ctypes.c_float) for name in Constants._fields),
        *((name, ctypes.c_void_p) for name in ("index", "depth", "sigma", "far", "depth_sum", "alpha")),
        *((name, ctypes.c_void_p) for name in ("by_depth_sum", "by_alpha")),
        ("total", ctypes.c_double),
        ("upstream", ctypes.c_float),
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
    kernel.d2_depth_loss_backward.argtypes, kernel.d2_depth_loss_backward.restype = call, None
    kernel.d2_depth_loss_size.restype = ctypes.c_int64
    size = kernel.d2_depth_loss_size()
    assert size == ctypes.sizeof(_Call), "the call differs between native_depth_loss.py and depth_loss.cpp"
    return kernel


def can_compare(depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels) -> bool:
    """Whether the kernel takes these: float32 on the CPU, some known pixels, and there is a compiler."""
    parts = depth_sum, alpha, pixels.depth, pixels.sigma
    fit = all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts) and len(pixels.index) > 0
    return fit and depth_sum.shape == alpha.shape and library() is not None


def native_depth_loss(depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, constants: Constants) -> Tensor:
    """See `depth_loss.pixel_depth_loss`; differentiable once by `depth_sum` and `alpha`."""
    return _DepthLoss.apply(depth_sum, alpha, pixels, constants)


class _DepthLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, constants: Constants) -> Tensor:
        kernel = library()
        assert kernel is not None, "native_depth_loss is for where can_compare is True"
        depth_sum, alpha = depth_sum.contiguous(), alpha.contiguous()
        slopes = torch.empty(2, len(pixels.index))
        near = max(pixels.near, 1)
        constants = constants._replace(opaque=constants.opaque / near)
        call = _Call(len(pixels.index), depth_sum.numel(), torch.get_num_threads(), *constants)
        call.depth, call.sigma = pixels.depth.data_ptr(), pixels.sigma.data_ptr()
        call.index, call.far = pixels.index.data_ptr(), pixels.far.data_ptr()
        call.depth_sum, call.alpha = depth_sum.data_ptr(), alpha.data_ptr()
        call.by_depth_sum, call.by_alpha = slopes.data_ptr(), slopes.data_ptr() + 4 * len(pixels.index)
        loss = kernel.d2_depth_loss(call)
        ctx.call, ctx.pixels, ctx.kernel, ctx.shape = call, pixels, kernel, depth_sum.shape
        ctx.save_for_backward(slopes)  # the rest of the call is not looked at again, or lives in `pixels`
        return depth_sum.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        found = slopes.new_empty(ctx.shape), slopes.new_empty(ctx.shape)
        ctx.call.upstream = upstream.item()
        ctx.call.grad_depth_sum, ctx.call.grad_alpha = found[0].data_ptr(), found[1].data_ptr()
        ctx.kernel.d2_depth_loss_backward(ctx.call)
        return *found, None, None

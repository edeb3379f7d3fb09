"""The background behind all Gaussians, interpolated and composited with its gradients, in `kernels/background.cpp`.

In torch it is a fifth of a training step of 50,000 Gaussians at 640x360. Compiled at first use; runs on
`torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler import load_kernel
from d2_plugin.gaussians.native_slice import FLAGS, KERNELS, SHARED_HEADERS


class _Call(ctypes.Structure):
    """d2::Background of kernels/background.cpp: an image and the nodes of its background."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("height", "width", "rows", "columns", "stride", "terms", "threads")),
        *((name, ctypes.c_void_p) for name in ("basis", "constant", "harmonics", "color", "alpha", "out")),
        *((name, ctypes.c_void_p) for name in ("grad_out", "grad_alpha", "grad_constant", "grad_harmonics")),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler.

    Raises:
        CompileError: see `d2_plugin.compiler.load_kernel`.
    """
    results = {"d2_background": None, "d2_background_backward": None}
    return load_kernel("background", KERNELS / "background.cpp", SHARED_HEADERS, FLAGS, _Call, results)


def can_composite(*parts: Tensor) -> bool:
    """Whether the kernel takes these tensors: float32 on the CPU, where there is a compiler."""
    return all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts) and library() is not None


def composite_background(
    color: Tensor, alpha: Tensor, basis: Tensor, constant: Tensor, harmonics: Tensor, nodes: tuple[int, int, int]
) -> Tensor:
    """color + (1 - alpha) background, [H, W, 3], differentiable once by all but the basis.

    Args:
        color, alpha: of a render, [H, W, 3] and [H, W], float32 on the CPU.
        basis: spherical harmonics [rows * columns, K] of the directions of nodes, row by row.
        constant, harmonics: coefficients [1, 3] and [K - 1, 3]; a node has the colour basis @ coefficients + 1/2,
            limited to 0..1, and the pixels between nodes are interpolated.
        nodes: rows and columns of nodes, and the pixels from one to the next.
    """
    return _Composite.apply(color, alpha, basis, constant, harmonics, nodes)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, nodes = inputs
        color, *parts = (part.contiguous() for part in tensors)
        out, call = torch.empty_like(color), _call(parts, nodes)
        call.color, call.out = color.data_ptr(), out.data_ptr()
        _kernel().d2_background(call)
        ctx.save_for_backward(*parts)
        ctx.nodes = nodes
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        alpha, basis, constant, harmonics = ctx.saved_tensors
        gradient, call = gradient.contiguous(), _call((alpha, basis, constant, harmonics), ctx.nodes)
        by_alpha, by_constant, by_harmonics = (torch.empty_like(part) for part in (alpha, constant, harmonics))
        call.grad_out, call.grad_alpha = gradient.data_ptr(), by_alpha.data_ptr()
        call.grad_constant, call.grad_harmonics = by_constant.data_ptr(), by_harmonics.data_ptr()
        _kernel().d2_background_backward(call)
        return gradient, by_alpha, None, by_constant, by_harmonics, None


def _kernel() -> ctypes.CDLL:
    kernel = library()
    assert kernel is not None, "composite_background is for where can_composite is True"
    return kernel


def _call(parts: Any, nodes: tuple[int, int, int]) -> _Call:
    alpha, basis, constant, harmonics = parts
    call = _Call(*alpha.shape, *nodes, basis.shape[1], torch.get_num_threads())
    call.alpha, call.basis = alpha.data_ptr(), basis.data_ptr()
    call.constant, call.harmonics = constant.data_ptr(), harmonics.data_ptr()
    return call

"""The background behind all Gaussians, interpolated and composited with its gradients, in `kernels/background.cpp`.

In torch it is a fifth of a training step of 50,000 Gaussians at 640x360. Compiled at first use; runs on
`torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler.kernels import load_kernel, structure
from d2_plugin.gaussians.native_slice import FLAGS, KERNELS, SHARED_HEADERS

_Call = structure(
    "int height width rows columns stride terms threads",
    "pointer basis constant harmonics color alpha out grad_out grad_alpha grad_constant grad_harmonics",
)
"""d2::Background of kernels/background.cpp: an image and the nodes of its background."""


@functools.cache
def library() -> Any:
    """The compiled kernel; None without a compiler."""
    results = {"d2_background": None, "d2_background_backward": None}
    sources = (KERNELS / "background.cpp",)
    return load_kernel("background", sources, SHARED_HEADERS, FLAGS, {"background": _Call}, results, optional=True)


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
        call.point(color=color, out=out)
        library().d2_background(call)
        ctx.save_for_backward(*parts)
        ctx.nodes = nodes
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        alpha, basis, constant, harmonics = ctx.saved_tensors
        gradient, call = gradient.contiguous(), _call((alpha, basis, constant, harmonics), ctx.nodes)
        by_alpha, by_constant, by_harmonics = (torch.empty_like(part) for part in (alpha, constant, harmonics))
        call.point(grad_out=gradient, grad_alpha=by_alpha, grad_constant=by_constant, grad_harmonics=by_harmonics)
        library().d2_background_backward(call)
        return gradient, by_alpha, None, by_constant, by_harmonics, None


def _call(parts: Any, nodes: tuple[int, int, int]) -> Any:
    alpha, basis, constant, harmonics = parts
    call = _Call(*alpha.shape, *nodes, basis.shape[1], torch.get_num_threads())
    call.point(alpha=alpha, basis=basis, constant=constant, harmonics=harmonics)
    return call

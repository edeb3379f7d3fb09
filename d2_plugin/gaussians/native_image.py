"""The small passes between Gaussians and image, in `kernels/image.cpp`: colours, background, screen gradients.

Each replaces some ten torch operations, which at the size of a training step cost more than the work in them.
Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.gaussians.native_slice import FLAGS, KERNELS, SHARED_HEADERS

_int, _long, _float, _pointer = ctypes.c_int32, ctypes.c_int64, ctypes.c_float, ctypes.c_void_p


class _Behind(ctypes.Structure):
    """d2::Behind of kernels/image.cpp: an image and the nodes of its background."""

    _fields_ = (
        *((name, _int) for name in ("height", "width", "rows", "columns", "stride", "terms", "threads")),
        *((name, _pointer) for name in ("basis", "constant", "harmonics", "color", "alpha", "out")),
        *((name, _pointer) for name in ("grad_out", "more_alpha", "grad_alpha", "grad_constant", "grad_harmonics")),
    )


_SIGNATURES = {
    "d2_colors": (_pointer, _pointer, _long, _pointer, _int),
    "d2_colors_backward": (_pointer, _pointer, _pointer, _long, _long, _pointer, _int),
    "d2_screen": (_pointer, _pointer, _long, _float, _float, _pointer, _pointer, _int),
    "d2_behind": (ctypes.POINTER(_Behind),),
    "d2_behind_backward": (ctypes.POINTER(_Behind),),
}


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler, of which the rasterizer has warned already.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("image", (KERNELS / "image.cpp",), SHARED_HEADERS, FLAGS)
    except NoCompiler:
        return None
    for name, arguments in _SIGNATURES.items():
        getattr(kernel, name).argtypes, getattr(kernel, name).restype = arguments, None
    kernel.d2_behind_size.restype = _long
    size = kernel.d2_behind_size()
    assert size == ctypes.sizeof(_Behind), "the call differs between native_image.py and image.cpp"
    return kernel


def _kernel() -> ctypes.CDLL:
    """The kernel, where `can_draw` has found that there is one."""
    found = library()
    if found is None:
        raise NoCompiler("colours in C++ need a compiler: use torch where `can_draw` is False")
    return found


def can_draw(*parts: Tensor) -> bool:
    """Whether the kernel takes these tensors: float32 on the CPU, where there is a compiler."""
    return all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts) and library() is not None


def constant_colors(base: Tensor, rows: Tensor | None) -> Tensor:
    """max(0, Y_0 base + 1/2) [M, 3] of the Gaussians `rows`, differentiable once.

    Args:
        base: coefficients [N, 1, 3] of the constant harmonic, float32 on the CPU.
        rows: int64 [M], ascending; None for all of them.
    """
    return _Colors.apply(base, rows)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, base: Tensor, rows: Tensor | None) -> Tensor:
        base = base.contiguous()
        drawn = len(base) if rows is None else len(rows)
        colors = base.new_empty(drawn, 3)
        address = None if rows is None else rows.data_ptr()
        _kernel().d2_colors(base.data_ptr(), address, drawn, colors.data_ptr(), torch.get_num_threads())
        ctx.save_for_backward(colors, rows)
        ctx.shape = base.shape
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        colors, rows = ctx.saved_tensors
        gradient, found = gradient.contiguous(), gradient.new_empty(ctx.shape)
        address = None if rows is None else rows.data_ptr()
        pointers = colors.data_ptr(), gradient.data_ptr(), address
        threads = torch.get_num_threads()
        _kernel().d2_colors_backward(*pointers, len(colors), ctx.shape[0], found.data_ptr(), threads)
        return found, None


def composite_background(
    color: Tensor, alpha: Tensor, basis: Tensor, constant: Tensor, harmonics: Tensor, nodes: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """color + (1 - alpha) background, [H, W, 3], differentiable once by all but the basis; and alpha.

    Whoever has more to do with alpha takes the one from here: its gradient is added up along with the background's,
    where torch would walk over the image once more, with threads of its own.

    Args:
        color, alpha: of a render, [H, W, 3] and [H, W], float32 on the CPU.
        basis: spherical harmonics [rows * columns, K] of the directions of nodes, row by row.
        constant, harmonics: coefficients [1, 3] and [K - 1, 3]; a node has the colour basis @ coefficients + 1/2,
            limited to 0..1, and the pixels between nodes are interpolated.
        nodes: rows and columns of nodes, and the pixels from one to the next.
    """
    return _Background.apply(color, alpha, basis, constant, harmonics, nodes)


class _Background(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        *tensors, nodes = inputs
        parts = tuple(part.contiguous() for part in tensors)
        out = torch.empty_like(parts[0])
        call = _call(parts, nodes)
        call.out = out.data_ptr()
        _kernel().d2_behind(call)
        ctx.save_for_backward(*parts[1:])
        ctx.nodes = nodes
        ctx.set_materialize_grads(False)
        return out, inputs[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor | None, more: Tensor | None) -> tuple[Tensor | None, ...]:
        if gradient is None:
            return None, more, None, None, None, None
        alpha, _, constant, harmonics = ctx.saved_tensors
        gradient, more = gradient.contiguous(), None if more is None else more.contiguous()
        call = _call((None, *ctx.saved_tensors), ctx.nodes)
        found = torch.empty_like(alpha), torch.empty_like(constant), torch.empty_like(harmonics)
        call.grad_out, call.more_alpha = gradient.data_ptr(), None if more is None else more.data_ptr()
        call.grad_alpha, call.grad_constant, call.grad_harmonics = (part.data_ptr() for part in found)
        _kernel().d2_behind_backward(call)
        return gradient, found[0], None, found[1], found[2], None


def _call(parts: tuple[Tensor | None, ...], nodes: tuple[int, int, int]) -> _Behind:
    color, alpha, basis, constant, harmonics = parts
    assert alpha is not None
    assert basis is not None
    call = _Behind(*alpha.shape, *nodes, basis.shape[1], torch.get_num_threads())
    pointers = (None if part is None else part.data_ptr() for part in (basis, constant, harmonics, color, alpha))
    call.basis, call.constant, call.harmonics, call.color, call.alpha = pointers
    return call


def add_screen_gradients(gradient: Tensor, rows: Tensor, size: tuple[int, int], sums: Tensor, seen: Tensor) -> None:
    """Add the length of each screen-space gradient, in units of half the image, to the sums of its Gaussian.

    Args:
        gradient: [M, 2], per pixel.
        rows: int64 [M], which Gaussians these are.
        size: width and height of the image, pixels.
        sums, seen: [N], changed in place: summed lengths, and how many were not zero.
    """
    gradient, rows = gradient.contiguous(), rows.contiguous()
    width, height = size
    places = gradient.data_ptr(), rows.data_ptr(), len(rows), width / 2, height / 2
    _kernel().d2_screen(*places, sums.data_ptr(), seen.data_ptr(), torch.get_num_threads())

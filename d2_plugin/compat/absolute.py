"""The gradient that Deformable-3D-Gaussians densifies by: sums of absolute values over pixels.

In `kernels/absolute.cpp`, compiled at first use; single-threaded and on the CPU, wherever the Gaussians are.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler import load_library
from d2_plugin.protocol import RasterSettings, Splats, View
from d2_plugin.rasterizer.reference import project, visible

SOURCE = Path(__file__).parent / "kernels" / "absolute.cpp"

_GAUSSIANS = ("x", "y", "ux", "uy", "vy", "opacity", "reach_x", "reach_y", "values")


class _Walk(ctypes.Structure):
    """d2::Walk of kernels/absolute.cpp."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("width", "height", "channels", "count")),
        *((name, ctypes.c_float) for name in ("alpha_min", "alpha_max", "transmittance_min")),
        *((name, ctypes.c_void_p) for name in (*_GAUSSIANS, "image", "gradient", "sums")),
    )


class Drawing(NamedTuple):
    """An image and what it was drawn from."""

    splats: Splats
    values: Tensor  # [M, C] colours, and whatever else was composited
    view: View
    settings: RasterSettings


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernel.

    Raises:
        NoCompiler, CompileError: see `d2_plugin.compiler.load_library`.
    """
    kernel = load_library("absolute", (SOURCE,))
    kernel.d2_absolute.argtypes, kernel.d2_absolute.restype = (ctypes.POINTER(_Walk),), None
    kernel.d2_walk_size.restype = ctypes.c_int64
    assert kernel.d2_walk_size() == ctypes.sizeof(_Walk), "the call differs between absolute.py and absolute.cpp"
    return kernel


class WithAbsoluteGradient(torch.autograd.Function):
    """The image unchanged; `points` [N, 3] receive absolute_gradient in normalised device coordinates."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, points: Tensor, drawing: Drawing) -> Tensor:
        """`image` [H, W, C] as it is."""
        ctx.drawing, ctx.shape = drawing, points.shape
        ctx.save_for_backward(image)
        return image.view_as(image)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        """The image's own gradient, and the absolute one."""
        (image,) = ctx.saved_tensors
        view, rows = ctx.drawing.view, ctx.drawing.splats.rows
        sums = absolute_gradient(ctx.drawing, image, gradient)
        points = sums.new_zeros(ctx.shape)
        points[rows, :2] = sums * sums.new_tensor([0.5 * view.width, 0.5 * view.height])
        return gradient, points, None


@torch.no_grad()
def absolute_gradient(drawing: Drawing, image: Tensor, gradient: Tensor) -> Tensor:
    """Sum over pixels p of |dL_p/d(screen centre)|, [M, 2] in pixels, for `gradient` [H, W, C] = dL/d(image).

    Raises:
        NoCompiler: there is no compiler, and these sums have no other way.
    """
    splats, values, view, settings = drawing
    kept = visible(splats, None, view, settings)
    part = Splats(*(field[kept] for field in splats))
    screen = project(part, view, settings)
    order = torch.sort(screen.depths, stable=True).indices
    ux, vy = screen.variance_x_given_y.rsqrt(), screen.variance_y.rsqrt()
    reach = screen.reach(settings.alpha_min)
    columns = (
        *screen.centers.unbind(-1),
        ux,
        -screen.slope * ux,
        vy,
        screen.opacities,
        *reach.unbind(-1),
        values[kept],
    )
    arrays = {name: _plain(column[order]) for name, column in zip(_GAUSSIANS, columns)}
    arrays |= {"image": _plain(image), "gradient": _plain(gradient), "sums": torch.zeros(len(order), 2)}
    walk = _Walk(view.width, view.height, image.shape[-1], len(order))
    walk.alpha_min, walk.alpha_max = settings.alpha_min, settings.alpha_max
    walk.transmittance_min = settings.transmittance_min
    for name, array in arrays.items():
        setattr(walk, name, array.data_ptr())
    library().d2_absolute(ctypes.byref(walk))
    found = torch.zeros(len(splats.means), 2).to(splats.means)
    found[kept[order]] = arrays["sums"].to(found)
    return found


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", torch.float32).contiguous()

"""The kernels on the CPU: `kernels/cpu.cpp` through its C ABI.

Compiled at first use (`d2_plugin.compiler`). Tensors are float32, contiguous and on the CPU: `autograd` sees to that.
Runs on `torch.get_num_threads()` threads; results are the same bits for any number of them. A thread that calls keeps
its scratch memory (about 64 bytes per Gaussian and tile for the backward pass) for the next call.
"""

from __future__ import annotations

import ctypes
import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.errors import D2Error
from d2_plugin.protocol import Survey
from d2_plugin.rasterizer.reference import refuse_skew

KERNELS = Path(__file__).parent / "kernels"
"""Sources of the kernels."""

RECORD = 16
"""Floats of a projected Gaussian, one cache line; the same everywhere, so that the operators have one shape."""

SOURCES = (KERNELS / "cpu.cpp",)
HEADERS = tuple(KERNELS / name for name in ("splat.h", "simd.h", "parallel.h", "frame.h", "binning.h"))
FLAGS = ("-ffp-contract=off",)
"""The same formula must give the same bits wherever it is inlined; see kernels/simd.h."""

_float, _int, _long, _bool, _pointer = ctypes.c_float, ctypes.c_int32, ctypes.c_int64, ctypes.c_bool, ctypes.c_void_p


Pointing = TypeVar("Pointing", bound="PointingFrame")


class PointingFrame(ctypes.Structure):
    """A C structure with pointers into tensors, which live as long as it does; absent pointers stay null.

    The Frames of the CPU and of the GPU are two of them.
    """

    def point(self: Pointing, **tensors: Tensor | None) -> Pointing:
        """Set pointers by name and keep their tensors alive as long as the frame."""
        for name, tensor in tensors.items():
            if tensor is not None:
                setattr(self, name, tensor.data_ptr())
        self.kept = (*getattr(self, "kept", ()), tensors)
        return self


class Frame(PointingFrame):
    """d2::Frame of kernels/frame.h: everything that one call works on; absent pointers stay null."""

    _fields_ = (
        ("rotation", _float * 9),
        ("translation", _float * 3),
        *((name, _float) for name in ("focal_x", "focal_y", "center_x", "center_y", "image_width", "image_height")),
        ("constants", _float * 7),
        *((name, _int) for name in ("width", "height", "channels", "threads", "chunks")),
        ("eps", _float),
        ("count", _long),
        *(
            (name, _pointer)
            for name in (
                *("means", "covariances", "opacities", "colors", "screen_offsets", "background"),
                *("prior_depth", "reliability", "near_edge"),
                *("records", "slots", "tiles", "ids", "blocks"),
                *("color", "depth_sum", "alpha", "front"),
                *("grad_color", "grad_depth_sum", "grad_alpha", "grad_front"),
                *("grad_means", "grad_covariances", "grad_opacities", "grad_colors"),
                *("grad_screen_offsets", "grad_background"),
                *("weight", "error", "max_weight", "front_weight", "hits"),
            )
        ),
    )


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernels.

    Raises:
        NoCompiler, CompileError: see `d2_plugin.compiler.load_library`.
    """
    kernels = load_library("rasterizer", SOURCES, HEADERS, FLAGS)
    frame = ctypes.POINTER(Frame)
    signatures = {
        "d2_frame_size": ((), _long),
        "d2_tile_count": ((frame,), _int),
        "d2_project": ((frame,), _long),
        "d2_render": ((frame, _long), _bool),
        "d2_survey": ((frame, _long), _bool),
        "d2_backward": ((frame, _long), _bool),
    }
    for name, (arguments, result) in signatures.items():
        getattr(kernels, name).argtypes, getattr(kernels, name).restype = arguments, result
    assert kernels.d2_frame_size() == ctypes.sizeof(Frame), "Frame differs between native.py and kernels/frame.h"
    return kernels


@functools.cache
def available() -> bool:
    """Whether the kernels are available; warns once where no compiler is found."""
    try:
        library()
    except NoCompiler as error:
        warnings.warn(
            f"{error}. Until then splatting runs in plain torch: the same images and gradients, but orders of "
            "magnitude slower and with much more memory.",
            stacklevel=4,
        )
        return False
    return True


def rasterize(
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
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """color [H, W, C], depth_sum, alpha and front [H, W], and the state that `backward` needs (records, lists).

    front is empty, [0], without `near_edge` [H, W].
    """
    frame = _frame(T_camera_world, K, width, height, constants, len(means), colors.shape[1])
    frame.point(means=means, covariances=covariances, opacities=opacities, colors=colors)
    frame.point(background=_background(background, colors), screen_offsets=screen_offsets)
    records, lists, pairs = _project(frame, means)
    color = means.new_empty(height, width, colors.shape[1])
    depth_sum, alpha = means.new_empty(height, width), means.new_empty(height, width)
    front = means.new_empty((0,) if near_edge is None else (height, width))
    frame.point(color=color, depth_sum=depth_sum, alpha=alpha, near_edge=near_edge, front=front)
    _run(library().d2_render, frame, pairs)
    return color, depth_sum, alpha, front, records, lists


def backward(
    grad_color: Tensor | None,
    grad_depth_sum: Tensor | None,
    grad_alpha: Tensor | None,
    grad_front: Tensor | None,
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    near_edge: Tensor | None,
    constants: list[float],
    color: Tensor,
    depth_sum: Tensor,
    alpha: Tensor,
    front: Tensor,
    records: Tensor,
    lists: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means, covariances, opacities, colors, background [C] and screen_offsets [M, 2]."""
    height, width, channels = color.shape
    frame = _frame(T_camera_world, K, width, height, constants, len(means), channels)
    frame.point(means=means, covariances=covariances, opacities=opacities, colors=colors)
    frame.point(background=_background(background, colors), screen_offsets=screen_offsets, records=records)
    frame.point(color=color, depth_sum=depth_sum, alpha=alpha, near_edge=near_edge, front=front)
    frame.point(grad_color=grad_color, grad_depth_sum=grad_depth_sum, grad_alpha=grad_alpha, grad_front=grad_front)
    tiles = library().d2_tile_count(frame)
    pairs = (len(lists) - len(means) - 1 - 2 * tiles) // 3
    _point_lists(frame, lists, pairs)
    grad_means, grad_covariances = torch.empty_like(means), torch.empty_like(covariances)
    grad_opacities, grad_colors = torch.empty_like(opacities), torch.empty_like(colors)
    grad_background, grad_screen_offsets = means.new_empty(channels), means.new_empty(len(means), 2)
    frame.point(grad_means=grad_means, grad_covariances=grad_covariances, grad_opacities=grad_opacities)
    frame.point(grad_colors=grad_colors, grad_background=grad_background, grad_screen_offsets=grad_screen_offsets)
    _run(library().d2_backward, frame, pairs)
    return grad_means, grad_covariances, grad_opacities, grad_colors, grad_background, grad_screen_offsets


def survey(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    prior_depth: Tensor,
    reliability: Tensor,
    near_edge: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    constants: list[float],
    eps: float,
) -> Survey:
    """See `d2_plugin.rasterizer.survey`; `prior_depth`, `reliability` and `near_edge` are [H, W] float32."""
    height, width = prior_depth.shape
    frame = _frame(T_camera_world, K, width, height, constants, len(means), 0)
    frame.eps = eps
    frame.point(means=means, covariances=covariances, opacities=opacities)
    frame.point(prior_depth=prior_depth, reliability=reliability, near_edge=near_edge)
    _, _, pairs = _project(frame, means)
    weight, error, max_weight, front = (torch.empty_like(opacities) for _ in range(4))
    hits = torch.empty(len(means), dtype=torch.int32)
    depth_sum, alpha = torch.empty_like(prior_depth), torch.empty_like(prior_depth)
    frame.point(depth_sum=depth_sum, alpha=alpha)
    frame.point(weight=weight, error=error, max_weight=max_weight, front_weight=front, hits=hits)
    _run(library().d2_survey, frame, pairs)
    return Survey(weight, error, max_weight, hits, depth_sum, alpha, front)


def _background(background: Tensor | None, colors: Tensor) -> Tensor:
    return colors.new_zeros(colors.shape[1]) if background is None else background


def _frame(
    T_camera_world: Tensor, K: Tensor, width: int, height: int, constants: list[float], count: int, channels: int
) -> Frame:
    frame = Frame(width=width, height=height, channels=channels, count=count, threads=torch.get_num_threads())
    frame.chunks = min(4 * frame.threads, max(1, count // 256))
    rows = T_camera_world.tolist()
    frame.rotation[:] = [*rows[0][:3], *rows[1][:3], *rows[2][:3]]
    frame.translation[:] = [row[3] for row in rows[:3]]
    (frame.focal_x, skew, frame.center_x), (_, frame.focal_y, frame.center_y), _ = K.tolist()
    refuse_skew(skew)
    frame.image_width, frame.image_height = width, height
    frame.constants[:] = constants
    return frame


def _project(frame: Frame, means: Tensor) -> tuple[Tensor, Tensor, int]:
    """Records [M, 16], an empty buffer for the lists of pairs, and their number."""
    tiles = library().d2_tile_count(frame)
    records = means.new_empty(len(means), RECORD)
    pairs = library().d2_project(frame.point(records=records))
    if pairs < 0:
        raise MemoryError(f"no memory for the projection of {len(means)} Gaussians")
    if pairs > 2**31 - 1:
        raise D2Error(f"{pairs} pairs of Gaussian and tile, at most 2^31 - 1 are possible: use a smaller image")
    lists = torch.empty(3 * pairs + len(means) + 1 + 2 * tiles, dtype=torch.int32)
    _point_lists(frame, lists, pairs)
    return records, lists, pairs


def _run(step: Callable[[Frame, int], bool], frame: Frame, pairs: int) -> None:
    if not step(frame, pairs):
        raise MemoryError(f"no memory for {pairs} pairs of Gaussian and tile")


def _point_lists(frame: Frame, lists: Tensor, pairs: int) -> None:
    """One buffer: blocks (64 bit) [pairs], ids [pairs], slots [M + 1], tiles [tiles, 2]."""
    frame.kept = (*frame.kept, lists)
    start = lists.data_ptr()
    frame.blocks = start
    frame.ids = start + 8 * pairs
    frame.slots = start + 12 * pairs
    frame.tiles = start + 12 * pairs + 4 * (frame.count + 1)

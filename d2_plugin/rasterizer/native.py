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
from typing import Any, TypeVar

import torch
from torch import Tensor

from d2_plugin.compiler import NoCompiler
from d2_plugin.compiler.kernels import Call, fields, load_kernel
from d2_plugin.errors import D2Error
from d2_plugin.rasterizer.reference import refuse_skew

KERNELS = Path(__file__).parent / "kernels"
"""Sources of the kernels."""

RECORD = 16
"""Floats of a projected Gaussian, one cache line; the same everywhere, so that the operators have one shape."""

SOURCES = (KERNELS / "cpu.cpp",)
HEADERS = tuple(KERNELS / name for name in ("splat.h", "simd.h", "parallel.h", "frame.h", "binning.h"))
FLAGS = ("-ffp-contract=off",)
"""The same formula must give the same bits wherever it is inlined; see kernels/simd.h."""

SLOWER = "runs in plain torch: the same images, but orders of magnitude slower and with much more memory."
Pinhole = tuple[Tensor, Tensor, int, int]  # T_camera_world, K, width, height

Pointing = TypeVar("Pointing", bound="PointingFrame")


class PointingFrame(Call):
    """A structure with pointers into tensors, which live as long as it does: the Frames of the CPU and of the GPU."""

    def pointing(self: Pointing, **tensors: Tensor | None) -> Pointing:
        """The frame itself, with pointers by name; it keeps their tensors alive."""
        self.point(**tensors)
        self.kept = (*getattr(self, "kept", ()), tensors)
        return self


class Frame(PointingFrame):
    """d2::Frame of kernels/frame.h: everything that one call works on."""

    _fields_ = fields(
        "float rotation[9] translation[3] focal_x focal_y center_x center_y image_width image_height constants[7]",
        "int width height channels threads chunks",
        "float eps",
        "long count",
        "pointer means covariances opacities colors screen_offsets background prior_depth reliability near_edge",
        "pointer records slots tiles ids blocks color depth_sum alpha front",
        "pointer grad_color grad_depth_sum grad_alpha grad_front",
        "pointer grad_means grad_covariances grad_opacities grad_colors grad_screen_offsets",
        "pointer weight error max_weight front_weight hits",
    )


@functools.cache
def library() -> Any:
    """The compiled kernels, or what `d2_plugin.compiler.load_library` raises: NoCompiler, CompileError."""
    results = {"d2_tile_count": ctypes.c_int32, "d2_project": ctypes.c_int64}
    kernels = load_kernel("rasterizer", SOURCES, HEADERS, FLAGS, {"frame": Frame}, results)
    for name in ("d2_render", "d2_survey", "d2_backward"):
        function = getattr(kernels, name)
        function.argtypes, function.restype = (ctypes.POINTER(Frame), ctypes.c_int64), ctypes.c_bool
    return kernels


@functools.cache
def available() -> bool:
    """Whether the kernels are available; warns once where no compiler is found."""
    try:
        library()
    except NoCompiler as error:
        warnings.warn(f"{error}. Until then splatting {SLOWER}", stacklevel=4)
        return False
    return True


def frame_of(
    means: Tensor, covariances: Tensor, opacities: Tensor, camera: Pinhole, constants: list[float], channels: int
) -> Frame:
    """What every call works on; tensors of the Gaussians are kept as long as the frame."""
    T_camera_world, K, width, height = camera
    frame = Frame(width=width, height=height, channels=channels, count=len(means), threads=torch.get_num_threads())
    frame.chunks = min(4 * frame.threads, max(1, frame.count // 256))
    rows = T_camera_world.tolist()
    frame.rotation[:] = [*rows[0][:3], *rows[1][:3], *rows[2][:3]]
    frame.translation[:] = [row[3] for row in rows[:3]]
    (frame.focal_x, skew, frame.center_x), (_, frame.focal_y, frame.center_y), _ = K.tolist()
    refuse_skew(skew)
    frame.image_width, frame.image_height = width, height
    frame.constants[:] = constants
    return frame.pointing(means=means, covariances=covariances, opacities=opacities)


def project(frame: Frame, means: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Records [M, 16] and an empty buffer for the lists of pairs of Gaussian and tile."""
    tiles = library().d2_tile_count(frame)
    records = means.new_empty(len(means), RECORD)
    pairs = library().d2_project(frame.pointing(records=records))
    if pairs < 0:
        raise MemoryError(f"no memory for the projection of {len(means)} Gaussians")
    if pairs > 2**31 - 1:
        raise D2Error(f"{pairs} pairs of Gaussian and tile, at most 2^31 - 1 are possible: use a smaller image")
    lists = means.new_empty(3 * pairs + len(means) + 1 + 2 * tiles, dtype=torch.int32)
    point_lists(frame, lists)
    return records, lists


def point_lists(frame: Frame, lists: Tensor) -> None:
    """One buffer: blocks (64 bit) [pairs], ids [pairs], slots [M + 1], tiles [tiles, 2]."""
    frame.kept = (*frame.kept, lists)
    frame.pairs = (len(lists) - frame.count - 1 - 2 * library().d2_tile_count(frame)) // 3
    start = lists.data_ptr()
    frame.blocks = start
    frame.ids = start + 8 * frame.pairs
    frame.slots = start + 12 * frame.pairs
    frame.tiles = start + 12 * frame.pairs + 4 * (frame.count + 1)


def render(frame: Frame, device: torch.device) -> None:
    """Fill color, depth_sum, alpha and, with a near edge, front."""
    _run(library().d2_render, _over_background(frame))


def backward(frame: Frame, device: torch.device) -> None:
    """Fill the gradients, but for the background's."""
    _run(library().d2_backward, _over_background(frame))


def gather(frame: Frame, device: torch.device) -> None:
    """Fill the statistics of the survey."""
    _run(library().d2_survey, frame)


def _over_background(frame: Frame) -> Frame:
    return frame if frame.background else frame.pointing(background=torch.zeros(frame.channels, device="cpu"))


def _run(step: Callable[[Frame, int], bool], frame: Frame) -> None:
    if not step(frame, frame.pairs):
        raise MemoryError(f"no memory for {frame.pairs} pairs of Gaussian and tile")

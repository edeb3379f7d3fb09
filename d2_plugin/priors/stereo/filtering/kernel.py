"""The compiled filter (`kernels/filter.cpp`, `kernels/precision.cpp`).

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler import load_library

SOURCES = tuple(Path(__file__).parent / "kernels" / name for name in ("filter.cpp", "precision.cpp"))
_STEREO = Path(__file__).parents[1] / "kernels"
_RASTERIZER = Path(__file__).parents[3] / "rasterizer" / "kernels"  # no import: only its header is shared
HEADERS = (_RASTERIZER / "parallel.h", *(_STEREO / name for name in ("lanes.h", "numbers.h")))
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

_int, _float, _double, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p


class _Slopes(ctypes.Structure):
    """d2::Slopes of kernels/filter.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "reach", "threads")),
        *((name, _pointer) for name in ("depth", "inverse", "slope_x", "slope_y")),
    )


class _Coherence(ctypes.Structure):
    """d2::Coherence of kernels/filter.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "radius", "stride", "threads")),
        ("relative", _float),
        *((name, _pointer) for name in ("gray", "inverse", "slope_x", "slope_y", "weights", "share")),
    )


class _Confirm(ctypes.Structure):
    """d2::Confirm of kernels/filter.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "their_width", "their_height", "between", "threads")),
        ("A", _double * 9),
        ("k", _double * 3),
        ("back_A", _float * 9),
        ("back_k", _float * 3),
        ("direction", _float * 3),
        ("rays", _double * 9),
        *((name, _float) for name in ("continuous", "reprojection_max", "relative_depth_max")),
        *((name, _float) for name in ("sine_min", "cosine_min", "sine_max", "cosine_max")),
        *((name, _double) for name in ("nudge", "nudge_squared")),
        *((name, _pointer) for name in ("depth", "theirs", "confirming", "information", "difference")),
    )


class _Scatter(ctypes.Structure):
    """d2::Scatter of kernels/precision.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "reach", "threads")),
        ("slack", _double),
        *((name, _pointer) for name in ("depth", "scatter")),
    )


class _Sigma(ctypes.Structure):
    """d2::Sigma of kernels/precision.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "threads")),
        *((name, _float) for name in ("matching", "gray_noise", "flattest", "per_incoherence")),
        *((name, _double) for name in ("of_scatter", "of_spread", "floor_squared")),
        *((name, _pointer) for name in ("depth", "coherence", "gradient", "parallax", "spread", "scatter", "sigma")),
    )


_CALLS = {"slopes": _Slopes, "coherence": _Coherence, "confirm": _Confirm, "scatter": _Scatter, "sigma": _Sigma}


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernel.

    Raises:
        NoCompiler, CompileError: see `d2_plugin.compiler.load_library`.
    """
    kernel = load_library("filter", SOURCES, HEADERS, FLAGS)
    for name, call in _CALLS.items():
        function, size = getattr(kernel, f"d2_{name}"), getattr(kernel, f"d2_{name}_size")
        function.argtypes, function.restype = (ctypes.POINTER(call),), None
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(call), f"the call of {name} differs between kernel.py and its source"
    return kernel


def slopes(depth: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse depth, and its slopes across and down per pixel, all float32 [H, W].

    Slopes are the flatter one-sided difference over `reach` pixels: at a depth edge one side runs over the edge and is
    the steeper one; a side without depth has no say. `depth` is contiguous float32, 0 where there is none.
    """
    inverse, across, down = (np.empty_like(depth) for _ in range(3))
    maps = {"depth": depth, "inverse": inverse, "slope_x": across, "slope_y": down}
    _run("slopes", _Slopes(reach=reach), depth.shape, maps)
    return inverse, across, down


def coherence(
    gray: np.ndarray,
    inverse: np.ndarray,
    slopes: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    radius: int,
    stride: int,
    relative: float,
) -> np.ndarray:
    """Share [H, W] of the neighbours that lie on a pixel's tangent plane (see `coherence.surface_coherence`).

    Args:
        gray: uint8 [H, W]; all arrays are contiguous.
        inverse: inverse depth float32 [H, W], 0 where there is none.
        slopes: of inverse depth across and down, float32 [H, W].
        weights: float32 [257] by difference of grey values; the last, 0, is that of a pixel outside.
        radius: half the side of the window, pixels.
        stride: pixels between the neighbours that are compared.
        relative: a neighbour agrees within this share of the inverse depth.
    """
    share = np.empty_like(inverse)
    arrays = {"gray": gray, "inverse": inverse, "slope_x": slopes[0], "slope_y": slopes[1], "weights": weights}
    call = _Coherence(radius=radius, stride=stride, relative=relative)
    _run("coherence", call, inverse.shape, arrays | {"share": share})
    return share


def confirm(
    shape: tuple[int, int],
    numbers: dict[str, Any],
    vectors: dict[str, np.ndarray],
    maps: dict[str, np.ndarray],
) -> None:
    """Add one source to the sums among `maps`, all contiguous (see `confirm.confirm`).

    Args:
        shape: [H, W] of the reference.
        numbers: fields of d2::Confirm.
        vectors: its small arrays.
        maps: the arrays that it points to.
    """
    call = _Confirm(**numbers)
    for name, values in vectors.items():
        getattr(call, name)[:] = values.ravel().tolist()
    _run("confirm", call, shape, maps)


def scatter(depth: np.ndarray, reach: int, slack: float) -> np.ndarray:
    """See `precision.plane_scatter`; depth is contiguous float32, `slack` is added to the window's second moments."""
    out = np.empty(depth.shape)
    _run("scatter", _Scatter(reach=reach, slack=slack), depth.shape, {"depth": depth, "scatter": out})
    return out


def sigma(numbers: dict[str, float], maps: dict[str, np.ndarray]) -> np.ndarray:
    """See `precision.geometric_sigma`.

    Args:
        numbers: fields of d2::Sigma.
        maps: the contiguous arrays that it points to, but for the result.
    """
    out = np.empty(maps["depth"].shape, np.float32)
    _run("sigma", _Sigma(**numbers), out.shape, maps | {"sigma": out})
    return out


def _run(name: str, call: Any, shape: tuple[int, ...], arrays: dict[str, np.ndarray]) -> None:
    call.height, call.width = shape
    call.threads = torch.get_num_threads()
    for field, array in arrays.items():
        assert array.flags.c_contiguous, field
        setattr(call, field, array.ctypes.data)
    getattr(library(), f"d2_{name}")(ctypes.byref(call))

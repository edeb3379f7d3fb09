"""The compiled filter (`kernels/filter.cpp`, `kernels/precision.cpp`): the bits of the NumPy code in less time.

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler import NoCompiler, load_library

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
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler: NumPy then does the same.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("filter", SOURCES, HEADERS, FLAGS)
    except NoCompiler:
        return None
    for name, call in _CALLS.items():
        function, size = getattr(kernel, f"d2_{name}"), getattr(kernel, f"d2_{name}_size")
        function.argtypes, function.restype = (ctypes.POINTER(call),), None
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(call), f"the call of {name} differs between kernel.py and its source"
    return kernel


def slopes(depth: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See `coherence.reference_slopes`; depth is contiguous float32."""
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
    """See `coherence.reference_share`; all arrays are contiguous."""
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
    """See `confirm.confirm`: add what one source says to the sums among `maps`, all contiguous.

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
    """See `precision.reference_scatter`; depth is contiguous float32."""
    found = np.empty(depth.shape)
    _run("scatter", _Scatter(reach=reach, slack=slack), depth.shape, {"depth": depth, "scatter": found})
    return found


def sigma(numbers: dict[str, float], maps: dict[str, np.ndarray]) -> np.ndarray:
    """See `precision.reference_sigma`.

    Args:
        numbers: fields of d2::Sigma.
        maps: the contiguous arrays that it points to, but for the result.
    """
    found = np.empty(maps["depth"].shape, np.float32)
    _run("sigma", _Sigma(**numbers), found.shape, maps | {"sigma": found})
    return found


def _run(name: str, call: Any, shape: tuple[int, ...], arrays: dict[str, np.ndarray]) -> None:
    call.height, call.width = shape
    call.threads = torch.get_num_threads()
    for field, array in arrays.items():
        assert array.flags.c_contiguous, field
        setattr(call, field, array.ctypes.data)
    getattr(library(), f"d2_{name}")(ctypes.byref(call))

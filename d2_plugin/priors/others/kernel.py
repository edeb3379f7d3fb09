"""The compiled questions to the other views (`kernels/ask.cpp`): what the NumPy code of ask.py answers.

Both round alike but for the last digits of logarithms and exponentials, which NumPy and the C library take apart.
Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from d2_plugin.captures.capture import Camera
from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.priors.geometry import CONTINUOUS, view_pair
from d2_plugin.priors.others import ask
from d2_plugin.protocol import Label

SOURCE = Path(__file__).parent / "kernels" / "ask.cpp"
HEADERS = (Path(__file__).parents[2] / "rasterizer" / "kernels" / "parallel.h",)  # no import: only its header is shared
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

_int, _float, _double, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p


class _Other(ctypes.Structure):
    """d2::Other of kernels/ask.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height")),
        ("A", _double * 9),
        ("k", _double * 3),
        ("gain", _float * 3),
        *((name, _pointer) for name in ("mono_log", "surface", "surface_log", "sigma", "colors")),
    )


class _Ask(ctypes.Structure):
    """d2::Ask of kernels/ask.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "count", "compared", "threads", "steps", "fewest")),
        *((name, _float) for name in ("continuous", "like", "dark")),
        *((name, _double) for name in ("tolerance", "agreeing", "at_best", "alone", "one_place", "within", "near")),
        *((name, _double) for name in ("beside", "nudge", "log_nudge", "flattest", "longest", "met", "missed")),
        ("overshot", _double),
        *((name, ctypes.c_uint8) for name in ("label_mono", "label_agreed", "label_verified")),
        *((name, _pointer) for name in ("others", "rows", "columns", "surface", "colors")),
        *((name, _pointer) for name in ("labels", "depth", "sigma")),
    )


_NUMBERS = {
    "continuous": CONTINUOUS,
    "like": ask.LIKE * 255,
    "dark": ask.DARK,
    "steps": ask.STEPS,
    "fewest": ask.FEWEST,
    "one_place": ask.ONE_PLACE,
    "within": ask.WITHIN,
    "near": ask.NEAR,
    "beside": ask.BESIDE,
    "nudge": ask.NUDGE,
    "log_nudge": float(np.log(ask.NUDGE)),
    "flattest": ask.FLATTEST,
    "longest": ask.LONGEST,
    "met": ask.MET,
    "missed": ask.MISSED,
    "overshot": ask.OVERSHOT,
    "label_mono": int(Label.MONO),
    "label_agreed": int(Label.AGREED),
    "label_verified": int(Label.VERIFIED),
}


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler: NumPy then does the same.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("evidence", (SOURCE,), HEADERS, FLAGS)
    except NoCompiler:
        return None
    kernel.d2_inform.argtypes, kernel.d2_inform.restype = (ctypes.POINTER(_Ask),), None
    for name, structure in ("ask", _Ask), ("other", _Other):
        size = getattr(kernel, f"d2_{name}_size")
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(structure), f"{structure.__name__} differs between kernel.py and ask.cpp"
    return kernel


def inform(
    labels: np.ndarray,
    depth: np.ndarray,
    sigma: np.ndarray,
    name: str,
    views: Mapping[str, ask.View],
    cameras: Mapping[str, Camera],
    numbers: Mapping[str, float],
) -> None:
    """Change the mono-only pixels of view `name` in place, as `evidence.with_evidence` says.

    Args:
        labels: uint8 [H, W].
        depth: float32 [H, W].
        sigma: float32 [H, W].
        name: of the view.
        views: all of one instant, by camera.
        cameras: their calibrations.
        numbers: `tolerance` in log depth, the factors of sigma `agreeing` and `alone`, and `at_best`.
    """
    ours = views[name]
    asked = [other for other in views if other != name]
    others = (_Other * len(asked))(*(_other(views[other], cameras[name], cameras[other]) for other in asked))
    call = _Ask(**_NUMBERS, **numbers, count=len(asked), compared=len(ours.compared[0]))
    call.threads = torch.get_num_threads()
    call.height, call.width = labels.shape
    call.others = ctypes.addressof(others)
    call.rows, call.columns = (_address(values, np.int64) for values in ours.compared)
    call.surface, call.colors = _address(ours.surface, np.float32), _address(ours.colors, np.uint8)
    call.labels = _address(labels, np.uint8)
    call.depth, call.sigma = _address(depth, np.float32), _address(sigma, np.float32)
    kernel = library()
    assert kernel is not None, "asked without a compiler"
    kernel.d2_inform(ctypes.byref(call))


def _other(view: ask.View, ours: Camera, theirs: Camera) -> _Other:
    pair = view_pair(ours, theirs)
    other = _Other(gain=(1, 1, 1), colors=_address(view.colors, np.uint8))
    other.height, other.width = view.surface.shape
    other.A[:], other.k[:] = pair.A.ravel().tolist(), pair.k.tolist()
    for field in ("mono_log", "surface", "surface_log", "sigma"):
        setattr(other, field, _address(getattr(view, field), np.float32))
    return other


def _address(array: np.ndarray | None, dtype: type) -> int | None:
    """Where an array lies, which must be contiguous and of that type."""
    if array is None:
        return None
    assert array.flags.c_contiguous, "a kernel walks over contiguous memory"
    assert array.dtype == dtype, f"a kernel was promised {dtype.__name__} and got {array.dtype}"
    return array.ctypes.data

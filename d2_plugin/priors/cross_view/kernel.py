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

from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.priors.cross_view import ask
from d2_plugin.priors.geometry import CONTINUOUS, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera

SOURCE = Path(__file__).parent / "kernels" / "ask.cpp"
HEADERS = (Path(__file__).parents[2] / "rasterizer" / "kernels" / "parallel.h",)  # no import: only its header is shared
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

_int, _float, _double, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p


class _View(ctypes.Structure):
    """d2::View of kernels/ask.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height")),
        ("agreeing", _double),
        *((name, _pointer) for name in ("labels", "depth", "log", "sigma", "colors")),
        *((name, _pointer) for name in ("new_labels", "new_depth", "new_sigma")),
    )


class _Pair(ctypes.Structure):
    """d2::Pair of kernels/ask.cpp."""

    _fields_ = (("A", _double * 9), ("k", _double * 3), ("gain", _float * 3))


class _Ask(ctypes.Structure):
    """d2::Ask of kernels/ask.cpp."""

    _fields_ = (
        *((name, _int) for name in ("count", "threads", "compared", "steps", "fewest")),
        *((name, _float) for name in ("continuous", "like", "dark")),
        *((name, _double) for name in ("tolerance", "at_best", "alone", "one_place", "within", "near", "beside")),
        *((name, _double) for name in ("nudge", "log_nudge", "flattest", "longest", "met", "missed", "overshot")),
        *((name, ctypes.c_uint8) for name in ("label_mono", "label_agreed", "label_verified")),
        *((name, _pointer) for name in ("views", "pairs")),
    )


_NUMBERS = {
    "continuous": CONTINUOUS,
    "like": ask.LIKE * 255,
    "dark": ask.DARK,
    "compared": ask.COMPARED,
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
    for name, structure in ("ask", _Ask), ("pair", _Pair), ("view", _View):
        size = getattr(kernel, f"d2_{name}_size")
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(structure), f"{structure.__name__} differs between kernel.py and ask.cpp"
    return kernel


def inform(
    views: Mapping[str, ask.View],
    cameras: Mapping[str, Camera],
    agreeing: Mapping[str, float],
    numbers: Mapping[str, float],
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The maps of all views of an instant after each was asked: (labels, depth, sigma), as `with_evidence` says.

    Args:
        views: by camera.
        cameras: their calibrations.
        agreeing: by camera, the factor of sigma where another map agrees.
        numbers: `tolerance` in log depth, the factor of sigma `alone`, and `at_best`.
    """
    count = len(views)
    changed = {name: (view.labels.copy(), view.depth.copy(), view.sigma.copy()) for name, view in views.items()}
    shown = (_View * count)(*(_view(view, changed[name], agreeing[name]) for name, view in views.items()))
    pairs = (_Pair * count**2)(*(_pair(cameras[ours], cameras[theirs]) for ours in views for theirs in views))
    call = _Ask(**_NUMBERS, **numbers, count=count, threads=torch.get_num_threads())
    call.views, call.pairs = ctypes.addressof(shown), ctypes.addressof(pairs)
    kernel = library()
    assert kernel is not None, "asked without a compiler"
    kernel.d2_inform(ctypes.byref(call))
    return changed


def _view(view: ask.View, changed: tuple[np.ndarray, np.ndarray, np.ndarray], agreeing: float) -> _View:
    told = _View(agreeing=agreeing, labels=_address(view.labels, np.uint8), colors=_address(view.colors, np.uint8))
    told.height, told.width = view.labels.shape
    told.depth, told.log, told.sigma = (_address(map_, np.float32) for map_ in (view.depth, view.log, view.sigma))
    types = np.uint8, np.float32, np.float32
    told.new_labels, told.new_depth, told.new_sigma = map(_address, changed, types)
    return told


def _pair(ours: Camera, theirs: Camera) -> _Pair:
    pair = view_pair(ours, theirs)
    return _Pair(A=tuple(pair.A.ravel().tolist()), k=tuple(pair.k.tolist()), gain=(1, 1, 1))


def _address(array: np.ndarray | None, dtype: type) -> int | None:
    """Where an array lies, which must be contiguous and of that type."""
    if array is None:
        return None
    assert array.flags.c_contiguous, "a kernel walks over contiguous memory"
    assert array.dtype == dtype, f"a kernel was promised {dtype.__name__} and got {array.dtype}"
    return array.ctypes.data

"""Comparison of each mono-only pixel with the other views of its instant, compiled (`kernels/cross_view.cpp`).

Do the monocular maps of other cameras agree, and where does the pixel's ray meet a surface that another camera measured
by stereo? Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any
number of them.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from d2_plugin.compiler import load_library
from d2_plugin.priors.geometry import CONTINUOUS, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera

SOURCE = Path(__file__).parent / "kernels" / "cross_view.cpp"
HEADERS = (Path(__file__).parents[2] / "rasterizer" / "kernels" / "parallel.h",)  # no import: only its header is shared
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

WITHIN = 1.2
"""A surface confirms a monocular depth within this many of its standard deviations; farther ones are often another."""
NEAR = 0.1
"""And within this relative difference, whatever is declared."""
BESIDE = 0.03
"""Share of the step to the surface that may remain as error."""
LIKE = 0.04
"""Largest difference of the colours (0..1, mean of 3x3 pixels) of one place in two images. A ray that passes a near
thing which the map does not know meets the surface behind it, which mostly has another colour."""
DARK = 20
"""Of 255: a darker pixel does not tell how differently two cameras are exposed."""
FEWEST = 100
"""Fewer pixels than this that both verified do not tell it either."""
ONE_PLACE = 0.02
"""Nor does a pixel whose depth in the other view is off by more, in log depth."""
COMPARED = 8000
"""About how many verified pixels are compared for it, evenly over the image."""
STEPS = 3
"""Secant steps along the ray."""
NUDGE = 1.001
"""Factor of depth between the two points of a secant."""
FLATTEST = 0.2
"""Where the miss changes by less per log depth, the surface runs along the ray."""
LONGEST = 0.2
"""Longest step, in log depth."""
MET = 3e-3
"""The ray has met the surface when their depths differ by less than this share."""
MISSED = 0.5
"""A ray that misses by more, in log depth, is not followed."""
OVERSHOT = 2.0
"""Nor is one whose first step is so many times farther than allowed."""

_int, _float, _double, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p


@dataclass(frozen=True, eq=False)
class View:
    """One view of an instant; contiguous maps [H, W]."""

    labels: np.ndarray
    """`Label`, uint8."""
    depth: np.ndarray
    """float32."""
    log: np.ndarray
    """Logarithm of the depth, float32; infinite where there is none."""
    sigma: np.ndarray
    """float32."""
    colors: np.ndarray | None
    """Mean of 3x3 pixels, uint8 [H, W, 3]; None where there is no image."""


class _View(ctypes.Structure):
    """d2::View of kernels/cross_view.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height")),
        ("agreeing", _double),
        *((name, _pointer) for name in ("labels", "depth", "log", "sigma", "colors")),
        *((name, _pointer) for name in ("new_labels", "new_depth", "new_sigma")),
    )


class _Pair(ctypes.Structure):
    """d2::Pair of kernels/cross_view.cpp."""

    _fields_ = (("A", _double * 9), ("k", _double * 3), ("gain", _float * 3))


class _Instant(ctypes.Structure):
    """d2::Instant of kernels/cross_view.cpp."""

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
    "like": LIKE * 255,
    "dark": DARK,
    "compared": COMPARED,
    "steps": STEPS,
    "fewest": FEWEST,
    "one_place": ONE_PLACE,
    "within": WITHIN,
    "near": NEAR,
    "beside": BESIDE,
    "nudge": NUDGE,
    "log_nudge": float(np.log(NUDGE)),
    "flattest": FLATTEST,
    "longest": LONGEST,
    "met": MET,
    "missed": MISSED,
    "overshot": OVERSHOT,
    "label_mono": int(Label.MONO),
    "label_agreed": int(Label.AGREED),
    "label_verified": int(Label.VERIFIED),
}


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernel.

    Raises:
        NoCompiler, CompileError: see `d2_plugin.compiler.load_library`.
    """
    kernel = load_library("cross_view", (SOURCE,), HEADERS, FLAGS)
    kernel.d2_compare_views.argtypes, kernel.d2_compare_views.restype = (ctypes.POINTER(_Instant),), None
    for name, structure in ("instant", _Instant), ("pair", _Pair), ("view", _View):
        size = getattr(kernel, f"d2_{name}_size")
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(structure), f"{structure.__name__} differs between kernel.py and cpp"
    return kernel


def compare_views(
    views: Mapping[str, View],
    cameras: Mapping[str, Camera],
    agreeing: Mapping[str, float],
    numbers: Mapping[str, float],
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(labels, depth, sigma) of each view after its mono-only pixels were compared with all others (`with_evidence`).

    Args:
        views: by camera.
        cameras: their calibrations.
        agreeing: by camera, the factor of sigma where another map agrees.
        numbers: `tolerance` in log depth, the factor of sigma `alone`, and `at_best`.
    """
    count = len(views)
    changed = {name: (view.labels.copy(), view.depth.copy(), view.sigma.copy()) for name, view in views.items()}
    given = (_View * count)(*(_view(view, changed[name], agreeing[name]) for name, view in views.items()))
    pairs = (_Pair * count**2)(*(_pair(cameras[ours], cameras[theirs]) for ours in views for theirs in views))
    call = _Instant(**_NUMBERS, **numbers, count=count, threads=torch.get_num_threads())
    call.views, call.pairs = ctypes.addressof(given), ctypes.addressof(pairs)
    library().d2_compare_views(ctypes.byref(call))
    return changed


def _view(view: View, changed: tuple[np.ndarray, np.ndarray, np.ndarray], agreeing: float) -> _View:
    call = _View(agreeing=agreeing, labels=_address(view.labels, np.uint8), colors=_address(view.colors, np.uint8))
    call.height, call.width = view.labels.shape
    call.depth, call.log, call.sigma = (_address(map_, np.float32) for map_ in (view.depth, view.log, view.sigma))
    types = np.uint8, np.float32, np.float32
    call.new_labels, call.new_depth, call.new_sigma = map(_address, changed, types)
    return call


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

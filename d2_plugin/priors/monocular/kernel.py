"""The compiled parts of the alignment and of the local correction (`kernels/`): the numbers of the NumPy code.

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from d2_plugin.compiler import NoCompiler, load_library

SOURCES = (Path(__file__).parent / "kernels" / "correct.cpp",)
_STEREO = Path(__file__).parents[1] / "stereo" / "kernels"
_RASTERIZER = Path(__file__).parents[2] / "rasterizer" / "kernels"  # no import: only headers are shared
HEADERS = (_RASTERIZER / "parallel.h", *(_STEREO / name for name in ("lanes.h", "numbers.h")))
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none, and where its products have one it is written out."""

_int, _float, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p


class _Field(ctypes.Structure):
    """d2::Field of kernels/correct.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "cell", "maps", "scales", "rounds", "threads")),
        *((name, _float) for name in ("prior", "outlier", "outlier_squared")),
        ("bend_stride", ctypes.c_int64),
        *((name, _pointer) for name in ("bend", "known", "down", "across", "reach", "field")),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernels; None without a compiler: NumPy then does the same.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("monocular", SOURCES, HEADERS, FLAGS)
    except NoCompiler:
        return None
    for name, call in (("field", _Field),):
        function, size = getattr(kernel, f"d2_{name}"), getattr(kernel, f"d2_{name}_size")
        function.argtypes, function.restype = (ctypes.POINTER(call),), None
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(call), f"the call of {name} differs between kernel.py and kernels/"
    return kernel


def smooth_fields(
    bend: np.ndarray,
    known: np.ndarray,
    cell: int,
    blurs: Sequence[tuple[np.ndarray, np.ndarray, int]],
    *,
    prior: float,
    outlier: float,
    rounds: int,
) -> np.ndarray:
    """See `correct.cell_field`: the fields [maps, rows, columns] of several maps.

    Args:
        bend: correction of log depth float32 [maps, H, W]; maps may share one (a stride of 0).
        known: where it is known, bool [maps, H, W].
        cell: pixels of a side of a cell.
        blurs: of each scale the blurs of a column [rows, rows] and of a row [columns, columns] of cells, float32, and
            how many cells their windows reach.
        prior, outlier, rounds: see `correct`.
    """
    kernel = library()
    assert kernel is not None
    assert bend.dtype == np.float32
    assert bend[0].flags.c_contiguous
    maps, height, width = bend.shape
    known = np.ascontiguousarray(known, bool)
    down, across = (np.ascontiguousarray([blur[side] for blur in blurs], np.float32) for side in (0, 1))
    reach = np.array([blur[2] for blur in blurs], np.int32)
    field = np.empty((maps, down.shape[1], across.shape[1]), np.float32)
    call = _Field(width, height, cell, maps, len(blurs), rounds, torch.get_num_threads(), prior, outlier, outlier**2)
    call.bend_stride = bend.strides[0] // bend.itemsize
    arrays = {"bend": bend, "known": known, "down": down, "across": across, "reach": reach, "field": field}
    for name, array in arrays.items():
        setattr(call, name, array.ctypes.data)
    kernel.d2_field(ctypes.byref(call))
    return field

"""The smooth fields of the local correction, compiled (`kernels/correct.cpp`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import torch

from d2_plugin.priors.monocular.native.library import run

_int, _float, _pointer = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p


class _Field(ctypes.Structure):
    """d2::Field of kernels/correct.cpp."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "cell", "maps", "scales", "rounds", "threads")),
        *((name, _float) for name in ("prior", "outlier", "outlier_squared")),
        ("bend_stride", ctypes.c_int64),
        *((name, _pointer) for name in ("bend", "known", "down", "across", "reach", "field")),
    )


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
    run("field", call)
    return field

"""What alignment and fusion do to each pixel alone, compiled (`kernels/pixels.cpp`)."""

from __future__ import annotations

import ctypes

import numpy as np

from d2_plugin.priors.monocular.native.library import run
from d2_plugin.protocol import Label

_count, _float, _double, _pointer = ctypes.c_int64, ctypes.c_float, ctypes.c_double, ctypes.c_void_p


class _Aligned(ctypes.Structure):
    """d2::Aligned of kernels/pixels.cpp."""

    _fields_ = (
        ("count", _count),
        *((name, _double) for name in ("scale", "shift", "limit")),
        ("relative", _count),
        *((name, _pointer) for name in ("mono", "depth", "inverse")),
    )


class _Fused(ctypes.Structure):
    """d2::Fused of kernels/pixels.cpp."""

    _fields_ = (
        ("count", _count),
        ("tau", _float),
        ("epsilon", _float),
        ("most_vetoed", _double),
        *((name, _pointer) for name in ("mono", "geometric", "tau_map", "hanging", "sigma_mono", "sigma_geometric")),
        *((name, _pointer) for name in ("depth", "labels", "sigma")),
        *((name, ctypes.c_uint8) for name in ("empty", "mono_label", "verified", "conflict")),
    )


def aligned_depth(mono: np.ndarray, scale: float, shift: float, limit: float, relative: bool) -> np.ndarray:
    """See `align.aligned_depth`; `limit` is the smallest inverse depth (relative) or the largest depth (metric)."""
    mono, depth = np.ascontiguousarray(mono, np.float32), np.empty(mono.shape, np.float32)
    run("aligned", _Aligned(mono.size, scale, shift, limit, relative, mono.ctypes.data, depth.ctypes.data, None))
    return depth


def aligned_inverse(mono: np.ndarray, scale: float, shift: float, relative: bool) -> np.ndarray:
    """See `align.aligned_inverse`."""
    mono, inverse = np.ascontiguousarray(mono, np.float32), np.empty(mono.shape)
    run("aligned", _Aligned(mono.size, scale, shift, 0.0, relative, mono.ctypes.data, None, inverse.ctypes.data))
    return inverse


def fused(
    depths: tuple[np.ndarray, np.ndarray],
    sigmas: tuple[np.ndarray, np.ndarray],
    tau_c: float | np.ndarray,
    hanging: np.ndarray | None,
    most_vetoed: float,
    epsilon: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, labels and sigma of `fuse.fuse` with verification; pairs are (monocular, geometric), float32 [H, W]."""
    shape = depths[0].shape
    maps = [np.ascontiguousarray(values, np.float32) for values in (*depths, *sigmas)]
    assert all(values.shape == shape for values in maps)
    tau_map = None if np.ndim(tau_c) == 0 else np.ascontiguousarray(np.broadcast_to(tau_c, shape), np.float32)
    left_out = np.zeros(shape, bool) if hanging is None else np.ascontiguousarray(hanging, bool)
    assert left_out.shape == shape
    out = np.empty(shape, np.float32), np.empty(shape, np.uint8), np.empty(shape, np.float32)
    call = _Fused(maps[0].size, 0.0 if tau_map is not None else float(tau_c), epsilon, most_vetoed)
    call.tau_map = None if tau_map is None else tau_map.ctypes.data
    names = "mono", "geometric", "sigma_mono", "sigma_geometric", "hanging", "depth", "labels", "sigma"
    for name, array in zip(names, (*maps, left_out, *out)):
        setattr(call, name, array.ctypes.data)
    call.empty, call.mono_label, call.verified, call.conflict = Label.EMPTY, Label.MONO, Label.VERIFIED, Label.CONFLICT
    run("fused", call)
    return out

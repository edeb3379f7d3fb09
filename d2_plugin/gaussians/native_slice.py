"""The slice of a 4D model at an instant, forward and backward, in `kernels/slice4d.cpp`.

The same mathematics as `reference_slice` of slicing.py, some twenty times faster on a CPU: one pass over the parameters
each way instead of a hundred torch operations. Compiled at first use; runs on `torch.get_num_threads()` threads, and
results are the same bits for any number of them.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from d2_plugin.compiler.kernels import load_kernel, structure
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.rotation4d import SMALL_NORM

KERNELS = Path(__file__).parent / "kernels"
_RASTERIZER = Path(__file__).parents[1] / "rasterizer" / "kernels"  # no import: only its headers are shared
SHARED_HEADERS = (_RASTERIZER / "simd.h", _RASTERIZER / "parallel.h")
FLAGS = ("-ffp-contract=fast",)

STATIC = {"positions": 3, "log_scales": 3, "left": 4, "opacity_logits": 1}
"""Columns of the raw parameters of a model without time, in the order of `_Slice.apply`."""
TEMPORAL = {**STATIC, "times": 1, "log_time_scales": 1, "right": 4}

_Call = structure(
    "long count drawn",
    "float time marginal_cut log_scale_limit small_norm",
    "int threads",
    f"pointer {' '.join(TEMPORAL)} rows means covariances opacities",
    f"pointer grad_means grad_covariances grad_opacities {' '.join(f'grad_{name}' for name in TEMPORAL)}",
)
"""d2::Slice of kernels/slice4d.cpp: what one call works on."""


@functools.cache
def library() -> Any:
    """The compiled kernel; None without a compiler."""
    results = {"d2_slice_rows": ctypes.c_int64, "d2_slice_forward": None, "d2_slice_backward": None}
    sources = (KERNELS / "slice4d.cpp",)
    return load_kernel("slice4d", sources, SHARED_HEADERS, FLAGS, {"slice4d": _Call}, results, optional=True)


def can_slice(raw: Mapping[str, Tensor]) -> bool:
    """Whether the kernel takes these parameters: float32 on the CPU, where there is a compiler."""
    fit = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in raw.values())
    return fit and library() is not None


def native_slice(
    raw: Mapping[str, Tensor], time: float, marginal_cut: float, log_scale_limit: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The 3D Gaussians of a 4D model at an instant, differentiable once.

    Args:
        raw: parameters by name, float32 on the CPU: positions [N, 3], log_scales [N, 3], left [N, 4],
            opacity_logits [N]; with time also times [N], log_time_scales [N], right [N, 4].
        time: the instant, in the unit of `times`.
        marginal_cut: Gaussians whose temporal marginal F(t) is not above this are left out.
        log_scale_limit: log-scales saturate at plus and minus this.

    Returns:
        means [M, 3], covariances [M, 6] (xx xy xz yy yz zz), opacities [M] (F(t) included), rows [M] int64.

    Raises:
        D2Error: the parameters do not have one row for each Gaussian.
    """
    columns = TEMPORAL if "times" in raw else STATIC
    count = raw["positions"].shape[0]
    for name, width in columns.items():  # the kernel trusts its pointers
        if raw[name].numel() != count * width:
            shape = tuple(raw[name].shape)
            raise D2Error(f"{name} has shape {shape}, expected {width} numbers for each of {count} Gaussians: fix it")
    return _Slice.apply(float(time), marginal_cut, log_scale_limit, *(raw[name] for name in columns))


class _Slice(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, time: float, cut: float, limit: float, *raw: Tensor) -> tuple[Tensor, ...]:
        raw = tuple(tensor.contiguous() for tensor in raw)
        call = _prepare((time, cut, limit), raw)
        rows = _rows(call)
        count = call.drawn
        outputs = raw[0].new_empty(count, 3), raw[0].new_empty(count, 6), raw[0].new_empty(count)
        call.point(means=outputs[0], covariances=outputs[1], opacities=outputs[2])
        library().d2_slice_forward(call)
        ctx.constants = (time, cut, limit)
        ctx.save_for_backward(rows, *raw)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(rows)
        return (*outputs, rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        rows, *raw = ctx.saved_tensors
        call = _prepare(ctx.constants, raw)
        call.drawn = rows.shape[0]
        if call.times:
            call.point(rows=rows)
        incoming = [None if gradient is None else gradient.contiguous() for gradient in upstream[:3]]
        call.point(grad_means=incoming[0], grad_covariances=incoming[1], grad_opacities=incoming[2])
        gradients = [torch.empty_like(tensor) for tensor in raw]
        call.point(**{f"grad_{name}": gradient for name, gradient in zip(TEMPORAL, gradients)})
        library().d2_slice_backward(call)
        return None, None, None, *gradients


def _prepare(constants: tuple[float, float, float], raw: tuple[Tensor, ...]) -> Any:
    time, cut, limit = constants
    call = _Call(time=time, marginal_cut=cut, log_scale_limit=limit, small_norm=SMALL_NORM)
    call.count, call.threads = raw[0].shape[0], torch.get_num_threads()
    call.point(**dict(zip(TEMPORAL, raw)))
    return call


def _rows(call: Any) -> Tensor:
    """The Gaussians that are drawn, int64 [M]; sets `call.drawn` to M."""
    if not call.times:
        call.drawn = call.count
        return torch.arange(call.count, device="cpu")
    rows = torch.empty(call.count, dtype=torch.int64, device="cpu")
    call.point(rows=rows)
    call.drawn = library().d2_slice_rows(call)
    return rows[: call.drawn]

"""Adam over all tensors of a model in one call, in `kernels/adam.cpp`.

The same numbers as `torch.optim.Adam` within rounding and the same state (`step`, `exp_avg`, `exp_avg_sq`), so that
checkpoints, and whoever carries its moments along, see nothing new. Compiled at first use; results are the same bits
for any number of threads.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from d2_plugin.compiler import NoCompiler, load_library
from d2_plugin.gaussians.native_slice import FLAGS, KERNELS, SHARED_HEADERS


class _Tensor(ctypes.Structure):
    """d2::AdamTensor of kernels/adam.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("value", "first", "second", "gradient", "steps")),
        ("count", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("rate", "beta1", "beta2", "epsilon")),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None without a compiler, of which the rasterizer has warned already.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        kernel = load_library("adam", (KERNELS / "adam.cpp",), SHARED_HEADERS, FLAGS)
    except NoCompiler:
        return None
    kernel.d2_adam.argtypes, kernel.d2_adam.restype = (ctypes.POINTER(_Tensor), ctypes.c_int32, ctypes.c_int32), None
    kernel.d2_adam_size.restype = ctypes.c_int64
    assert kernel.d2_adam_size() == ctypes.sizeof(_Tensor), "the call differs between native_adam.py and adam.cpp"
    return kernel


class Adam(torch.optim.Adam):
    """`torch.optim.Adam` with its step in one kernel where all tensors are dense float32 on the CPU, else as it is."""

    _checked: tuple[tuple[Tensor, ...], ...] = ()
    """Parameters, moments and counters that were found plain before, in the order of the groups."""

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step of all parameters that have a gradient."""
        pairs = [(value, group) for group in self.param_groups for value in group["params"] if value.grad is not None]
        kernel = library() if closure is None else None
        if kernel is None or not all(_is_standard(group) for group in self.param_groups) or not self._are_plain(pairs):
            return super().step(closure)
        threads = torch.get_num_threads()
        updates = [_update(kept, group) for kept, (_, group) in zip(self._checked, pairs)]
        kernel.d2_adam((_Tensor * len(updates))(*updates), len(updates), threads)
        for value, _ in pairs:
            increment_version(value)  # a graph that still needs the old values is refused, as after torch's step
        return None

    def _are_plain(self, pairs: Sequence[tuple[Tensor, dict[str, Any]]]) -> bool:
        """Whether the kernel takes all parameters, gradients and states, which are made where they are missing."""
        if not all(_is_plain(value.grad) for value, _ in pairs):
            return False
        if len(self._checked) == len(pairs) and all(map(self._is_known, self._checked, pairs)):
            return True
        if not all(_is_plain(value) for value, _ in pairs):
            return False
        found = tuple(self._with_state(value) for value, _ in pairs)
        fit = all(_is_plain(part) for kept in found for part in kept)
        self._checked = found if fit else ()
        return fit

    def _is_known(self, kept: tuple[Tensor, ...], pair: tuple[Tensor, dict[str, Any]]) -> bool:
        value, first, second, steps = kept
        if value is not pair[0]:
            return False
        state = self.state.get(value, {})
        same = state.get("exp_avg") is first and state.get("exp_avg_sq") is second and state.get("step") is steps
        return same and value.shape == first.shape == second.shape

    def _with_state(self, value: Tensor) -> tuple[Tensor, ...]:
        state = self.state[value]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"] = torch.zeros_like(value, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(value, memory_format=torch.preserve_format)
        return value, state["exp_avg"], state["exp_avg_sq"], state["step"]


def _update(kept: tuple[Tensor, ...], group: dict[str, Any]) -> _Tensor:
    value, first, second, steps = kept
    gradient = value.grad
    assert gradient is not None
    places = value.data_ptr(), first.data_ptr(), second.data_ptr(), gradient.data_ptr(), steps.data_ptr()
    return _Tensor(*places, value.numel(), float(group["lr"]), *group["betas"], group["eps"])


def _is_standard(group: dict[str, Any]) -> bool:
    return not (group["weight_decay"] or group["amsgrad"] or group["maximize"] or group["differentiable"])


def _is_plain(part: Tensor | None) -> bool:
    return (
        part is not None
        and part.dtype == torch.float32
        and part.device.type == "cpu"
        and part.layout is torch.strided
        and part.is_contiguous()
    )

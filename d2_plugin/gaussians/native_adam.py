"""Adam over all tensors of a model in one call, in `kernels/adam.cpp`.

The same numbers as `torch.optim.Adam` within rounding and the same state (`step`, `exp_avg`, `exp_avg_sq`), so that
checkpoints, and whoever carries its moments along, see nothing new. Compiled at first use; results are the same bits for
any number of threads.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from d2_plugin.compiler import NoCompiler, load_library

from .native_slice import FLAGS, KERNELS, SHARED_HEADERS


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
    """`torch.optim.Adam` whose step is one kernel where all tensors are dense float32 on the CPU; else it is torch's."""

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step of all parameters that have a gradient."""
        updates = self._updates() if closure is None else None
        if updates is None:
            return super().step(closure)
        kernel = library()
        assert kernel is not None
        kernel.d2_adam((_Tensor * len(updates))(*updates), len(updates), torch.get_num_threads())
        for group in self.param_groups:
            for value in group["params"]:
                if value.grad is not None:
                    increment_version(value)  # a graph that still needs the old values is refused, as after torch's step
        return None

    def _updates(self) -> list[_Tensor] | None:
        """What the kernel has to do, or None where it cannot."""
        if library() is None:
            return None
        found = []
        for group in self.param_groups:
            plain = not (group["weight_decay"] or group["amsgrad"] or group["maximize"] or group["differentiable"])
            for value in group["params"]:
                if value.grad is None:
                    continue
                update = self._update(value, group) if plain else None
                if update is None:
                    return None
                found.append(update)
        return found

    def _update(self, value: Tensor, group: dict[str, Any]) -> _Tensor | None:
        gradient, state = value.grad, self.state[value]
        assert gradient is not None
        if not (_is_plain(value) and _is_plain(gradient)):
            return None
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"] = torch.zeros_like(value, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(value, memory_format=torch.preserve_format)
        kept = state["exp_avg"], state["exp_avg_sq"], state["step"]
        if not all(_is_plain(part) for part in kept):
            return None
        first, second = group["betas"]
        pointers = (part.data_ptr() for part in (value, *kept[:2], gradient, kept[2]))
        return _Tensor(*pointers, value.numel(), float(group["lr"]), first, second, group["eps"])


def _is_plain(part: Tensor) -> bool:
    return (
        part.dtype == torch.float32
        and part.device.type == "cpu"
        and part.layout is torch.strided
        and part.is_contiguous()
    )

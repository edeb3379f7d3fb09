"""Trainers that say device="cuda" and .cuda() everywhere, run on the CPU: cuda means cpu from then on."""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

log = logging.getLogger(__name__)

_NOTHING = ("empty_cache", "synchronize", "set_device", "reset_peak_memory_stats")
_ZERO = ("memory_allocated", "max_memory_allocated", "memory_reserved", "max_memory_reserved")


class CudaMeansCpu(TorchFunctionMode):
    """While entered, every device argument `cuda` of a torch function is `cpu`."""

    def __torch_function__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Call `function` with devices replaced."""
        if function is torch.device and args and isinstance(args[0], int):
            return torch.device("cpu")  # the number of a GPU, as in Ex4DGS's safe_state
        named = {name: _cpu(value, name == "device") for name, value in (kwargs or {}).items()}
        return function(*[_cpu(value) for value in args], **named)


class _Event:
    """A CUDA event that measures nothing."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def record(self, *_: Any) -> None: ...

    def elapsed_time(self, _: Any) -> float:
        return 0.0


def run_on_cpu() -> None:
    """Make `cuda` mean `cpu` in this process, from here on; cannot be undone."""
    log.warning("in this process device 'cuda' means 'cpu', and times of CUDA events are 0")
    torch.Tensor.cuda = lambda self, *_, **__: self  # type: ignore[method-assign]
    torch.nn.Module.cuda = lambda self, *_, **__: self  # type: ignore[method-assign]
    torch.cuda.Event = _Event  # type: ignore[misc, assignment]
    for name in _NOTHING:
        setattr(torch.cuda, name, lambda *_, **__: None)
    for name in _ZERO:
        setattr(torch.cuda, name, lambda *_, **__: 0)
    torch.cuda.current_device = lambda: 0
    torch.cuda.device_count = lambda: 0
    torch.cuda.is_available = lambda: False
    CudaMeansCpu().__enter__()


def _cpu(value: Any, is_device: bool = False) -> Any:
    if is_device and type(value) is int:
        return "cpu"
    if isinstance(value, torch.device):
        return torch.device("cpu") if value.type == "cuda" else value
    # Only whole device strings: "cuda" in another argument is not a torch function's.
    if isinstance(value, str) and (value == "cuda" or value.startswith("cuda:")):
        return "cpu"
    return value

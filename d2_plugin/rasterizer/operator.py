"""The torch operators of `ops`, or, with a torch that cannot define them (before 2.4), the same by plain autograd.

Images and gradients are the same bits either way. What is lost without operators: `torch.compile` breaks its graph at
the rasterizer instead of looking through it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Kernel = Callable[..., Any]


def custom_op(name: str, kernel: Kernel, *, device_types: str, **described: Any) -> Any:
    """`torch.library.custom_op` where torch has it, else a `PlainOperator` of the same use."""
    defined = getattr(torch.library, "custom_op", None)
    if defined is None:
        return PlainOperator(name, kernel, device_types)
    return defined(name, kernel, device_types=device_types, **described)


class PlainOperator:
    """As much of what `torch.library.custom_op` returns as `ops` uses: a kernel per device, and a backward pass."""

    def __init__(self, name: str, kernel: Kernel, device: str) -> None:
        self.name = name
        self._kernels = {device: kernel}
        self._function: type[torch.autograd.Function] | None = None

    def register_kernel(self, device: str) -> Callable[[Kernel], Kernel]:
        """What runs on the tensors of a device."""

        def keep(kernel: Kernel) -> Kernel:
            self._kernels[device] = kernel
            return kernel

        return keep

    def register_fake(self, kernel: Kernel) -> Kernel:
        """Shapes without values serve torch.compile alone, which has no use for a plain function."""
        return kernel

    def register_autograd(self, backward: Kernel, *, setup_context: Kernel) -> None:
        """The gradients, as `torch.library` takes them; there are none of second order."""
        run, save = self._run, setup_context

        class Differentiable(torch.autograd.Function):
            @staticmethod
            def forward(*inputs: Any) -> Any:
                return run(*inputs)

            @staticmethod
            def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
                save(ctx, inputs, output)

            @staticmethod
            @once_differentiable
            def backward(ctx: Any, *gradients: Tensor | None) -> Any:
                return backward(ctx, *gradients)

        self._function = Differentiable

    def __call__(self, *inputs: Any) -> Any:
        """Outputs as the kernel gives them, with gradients where `register_autograd` was called."""
        return self._run(*inputs) if self._function is None else self._function.apply(*inputs)

    def _run(self, *inputs: Any) -> Any:
        device = next(part.device.type for part in inputs if isinstance(part, Tensor))
        if device not in self._kernels:
            raise NotImplementedError(f"{self.name} has no kernel for {device}: have {', '.join(self._kernels)}")
        return self._kernels[device](*inputs)

"""What the descriptions of a call that go to the CPU and to the GPU kernels have in common."""

from __future__ import annotations

import ctypes
from typing import Self

from torch import Tensor

RECORD = 16
"""Floats of a projected Gaussian, one cache line; the same everywhere, so that the operators have one shape."""


class PointingFrame(ctypes.Structure):
    """A C structure with pointers into tensors, which live as long as it does; absent pointers stay null."""

    def point(self, **tensors: Tensor | None) -> Self:
        """Set pointers by name and keep their tensors alive as long as the frame."""
        for name, tensor in tensors.items():
            if tensor is not None:
                setattr(self, name, tensor.data_ptr())
        self.kept = (*getattr(self, "kept", ()), tensors)
        return self

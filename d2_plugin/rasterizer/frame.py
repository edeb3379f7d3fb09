"""The common part of the two Frames, which describe one call to the kernels of the CPU and of the GPU."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import TypeVar

from torch import Tensor

KERNELS = Path(__file__).parent / "kernels"
"""Sources of the kernels."""

RECORD = 16
"""Floats of a projected Gaussian, one cache line; the same everywhere, so that the operators have one shape."""


Frame = TypeVar("Frame", bound="PointingFrame")


class PointingFrame(ctypes.Structure):
    """A C structure with pointers into tensors, which live as long as it does; absent pointers stay null."""

    def point(self: Frame, **tensors: Tensor | None) -> Frame:
        """Set pointers by name and keep their tensors alive as long as the frame."""
        for name, tensor in tensors.items():
            if tensor is not None:
                setattr(self, name, tensor.data_ptr())
        self.kept = (*getattr(self, "kept", ()), tensors)
        return self

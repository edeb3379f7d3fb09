"""What the host and the kernels of `kernels/patchmatch.cu` share: files, constants, its Call, and who launches."""

from __future__ import annotations

import ctypes
from typing import Protocol

from d2_plugin.compiler.nvrtc import Program
from d2_plugin.priors.stereo.patchmatch_kernel import HEADERS, KERNELS, Task

PROGRAM = Program(KERNELS / "patchmatch.cu", tuple(path for path in HEADERS if path.name != "lanes.h"))

FLAGS = ("--std=c++17", "--fmad=false")
"""No contraction: the kernels say themselves what is fused, so that all devices return the same bits."""

THREADS = 64
"""Of a block; THREADS of patchmatch.cu."""


class Call(ctypes.Structure):
    """d2::Call of kernels/patchmatch.cu: what one launch works on."""

    _fields_ = (
        ("task", Task),
        ("colour", ctypes.c_int32),
        ("round", ctypes.c_int32),
        ("radius", ctypes.c_int32),
        ("tolerance", ctypes.c_float),
        ("averaged", ctypes.c_void_p),
    )


class Launcher(Protocol):
    """Runs kernels of patchmatch.cu on one device."""

    def launch(self, kernel: str, sources: int, blocks: int, call: Call) -> None:
        """Enqueue `kernel`, compiled for that many sources, on `blocks` blocks of THREADS threads; `call` is copied."""


def flags_for(sources: int) -> tuple[str, ...]:
    """What NVRTC, or nvcc, is told to compile the kernels for so many sources of a view."""
    return (*FLAGS, f"-DD2_MAX_SOURCES={sources}", f"-DD2_CALL_SIZE={ctypes.sizeof(Call)}")

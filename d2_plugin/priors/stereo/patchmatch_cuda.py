"""The kernels of PatchMatch on a CUDA device, through NVRTC: the same planes as on the CPU, from the same mathematics.

`kernels/spread.h` holds the mathematics once. Where the CPU fuses multiplications and additions, as every one since
2013 does, both devices return the same bits.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler.driver import Driver
from d2_plugin.compiler.kernels import fields
from d2_plugin.compiler.nvrtc import NoCuda, Program, build
from d2_plugin.priors.stereo.patchmatch_kernel import (
    CONSENSUS_PASSES,
    CONSENSUS_RADIUS,
    CONSENSUS_TOLERANCE,
    HEADERS,
    KERNELS,
    Arrays,
    PatchMatchKernel,
    Task,
)

PROGRAM = Program(KERNELS / "patchmatch.cu", HEADERS)

FLAGS = ("--std=c++17", "--fmad=false")
"""No contraction: the kernels say themselves what is fused, so that all devices return the same bits."""

THREADS = 64
"""Of a block; THREADS of patchmatch.cu."""


class Call(ctypes.Structure):
    """d2::Call of kernels/patchmatch.cu: what one launch works on."""

    _fields_ = (("task", Task), *fields("int colour round radius", "float tolerance", "pointer averaged"))


def flags_for(sources: int) -> tuple[str, ...]:
    """Flags of NVRTC to compile the kernels for so many sources of a view."""
    return (*FLAGS, f"-DD2_MAX_SOURCES={sources}", f"-DD2_CALL_SIZE={ctypes.sizeof(Call)}")


LEAST_SOURCES = 2
"""The kernels compiled for so many sources also average planes, which needs none."""


@functools.cache
def driver(device: torch.device) -> Driver:
    """The kernels on a CUDA device, compiled for so many sources of a view; `device` has an index.

    Raises:
        NoCuda: no driver, no NVRTC, or an architecture that it does not know.
    """
    return Driver(device, lambda sm, sources: build("patchmatch", PROGRAM, flags_for(sources), sm), LEAST_SOURCES)


@functools.cache
def why_not_usable() -> str | None:
    """Why planes do not spread on a GPU here, in one sentence; None where they do."""
    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    try:
        driver(current_device())
    except NoCuda as error:
        return str(error)
    return None


class CudaPatchMatchKernel(PatchMatchKernel):
    """`PatchMatchKernel` on torch's current CUDA device; maps come from and return to the CPU's memory.

    Raises:
        NoCuda: no driver, no NVRTC, or an architecture that it does not know.
    """

    def _start(self) -> None:
        self.device = current_device()
        self._driver = driver(self.device)

    def _spread(self, task: Any, arrays: Arrays) -> None:
        on_device = self._moved(task, arrays)
        call = Call(task=task)
        pixels, half = task.width * task.height, -(-task.width // 2) * task.height
        self._launch("d2_patchmatch_begin", task.source_count, pixels, call)
        for call.round in range(task.rounds):
            for call.colour in (0, 1):
                self._launch("d2_patchmatch_update", task.source_count, half, call)
        for name in ("planes", "costs"):
            arrays[name][...] = on_device[name].cpu().numpy()

    def _average(self, task: Any, arrays: Arrays) -> np.ndarray:
        on_device = self._moved(task, arrays)
        planes, averaged = on_device["planes"], torch.empty_like(on_device["planes"])
        for _ in range(CONSENSUS_PASSES):
            task.planes = planes.data_ptr()
            call = Call(task=task, radius=CONSENSUS_RADIUS, averaged=averaged.data_ptr())
            call.tolerance = CONSENSUS_TOLERANCE
            self._launch("d2_patchmatch_average", LEAST_SOURCES, task.width * task.height, call)
            planes, averaged = averaged, planes
        return planes.cpu().numpy()

    def _launch(self, kernel: str, sources: int, count: int, call: Call) -> None:
        self._driver.launch(kernel, sources, (-(-count // THREADS), 1), THREADS, call)

    def _moved(self, task: Any, arrays: Arrays) -> dict[str, torch.Tensor]:
        """Copies of the arrays on the device, which the task points to then; they must outlive its use."""
        tensors = {}
        for name, array in arrays.items():
            plain = array.view(np.int32) if array.dtype == np.uint32 else array  # torch's unsigned integers are young
            tensors[name] = torch.from_numpy(plain.copy()).to(self.device)
            setattr(task, name, tensors[name].data_ptr())
        return tensors


def current_device() -> torch.device:
    """Torch's current CUDA device, with its index."""
    return torch.device("cuda", torch.cuda.current_device())

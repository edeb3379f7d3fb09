"""The kernels of `kernels/gpu.cu` on a CUDA device: compiled for each number of colors, launched by the driver."""

from __future__ import annotations

import ctypes
import threading

import torch

from d2_plugin.compiler.driver import Driver
from d2_plugin.compiler.nvrtc import Binary, Program, build
from d2_plugin.rasterizer.cuda_frame import HEADERS, SOURCE, THREADS, Frame

CACHED_CHANNELS = 3
"""Number of colors of the kernels that also run the survey, which needs no colors."""

PROGRAM = Program(SOURCE, HEADERS)
FLAGS = ("--std=c++17", "--fmad=false")
"""No contraction: the forward and the backward pass must decide alike which fragments count; splat.h asks for fma."""


def flags_for(channels: int) -> tuple[str, ...]:
    """What NVRTC, or nvcc, is told to compile the kernels for so many colors."""
    return (*FLAGS, f"-DD2_CHANNELS={channels}", f"-DD2_FRAME_SIZE={ctypes.sizeof(Frame)}")


def binary_for(capability: int, channels: int) -> Binary:
    """The kernels for GPUs of compute capability `capability` (90 is sm_90) and `channels` colors, from the cache
    where they are there already.

    Raises:
        d2_plugin.compiler.nvrtc.NoCuda: no NVRTC, or it does not know the GPU.
        CompileError: NVRTC refused the source.
    """
    return build("rasterizer", PROGRAM, flags_for(channels), capability)


class CudaLauncher:
    """Launches the kernels on one CUDA device, on torch's current stream (`cuda_frame.Launcher`)."""

    def __init__(self, device: torch.device) -> None:
        """Compile (or find) the kernels for `device` and load them.

        Raises:
            NoCuda: no driver, no NVRTC, or an architecture that it does not know.
        """
        self._driver = Driver(device)
        self._functions: dict[tuple[str, int], ctypes.c_void_p] = {}
        self._modules: dict[int, ctypes.c_void_p] = {}
        self._guard = threading.Lock()
        self._module(CACHED_CHANNELS)

    def launch(self, kernel: str, blocks: int, frame: Frame, rows: int = 1) -> None:
        """See `Launcher.launch`; returns before the kernel has run."""
        function = self._function(kernel, frame.channels or CACHED_CHANNELS)
        self._driver.launch(function, (blocks, rows), THREADS, frame)

    def _function(self, kernel: str, channels: int) -> ctypes.c_void_p:
        key = (kernel, channels)
        if key not in self._functions:
            self._functions[key] = self._driver.function(self._module(channels), kernel)
        return self._functions[key]

    def _module(self, channels: int) -> ctypes.c_void_p:
        with self._guard:
            if channels not in self._modules:
                self._modules[channels] = self._driver.module(binary_for(self._driver.capability, channels))
            return self._modules[channels]

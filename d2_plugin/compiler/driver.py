"""The CUDA driver, by ctypes alone: modules and launches in torch's context and on its streams."""

from __future__ import annotations

import contextlib
import ctypes
import sys
import threading
from collections.abc import Callable, Iterator

import torch

from d2_plugin.compiler.nvrtc import Binary, NoCuda, library
from d2_plugin.errors import D2Error

LARGEST_GRID = (2**31 - 1, 65535)
"""Blocks that a grid may have each way."""


class Driver:
    """A program's kernels on one CUDA device, in the context that torch works in, by variants of their compilation."""

    def __init__(self, device: torch.device, build: Callable[[int, int], Binary], variant: int) -> None:
        """Find the driver and the device's context, and load a first variant.

        Args:
            device: with an index.
            build: compute capability (90 is sm_90) and variant to what NVRTC makes of the program.
            variant: to compile now, so that what is missing is known before the first launch.

        Raises:
            NoCuda: no driver, no NVIDIA GPU, no NVRTC, or an architecture that it does not know.
        """
        if torch.version.hip:
            raise NoCuda(f"{device} is an AMD GPU, the kernels are for NVIDIA's: use the CPU")
        self.device = device
        self._driver = load_driver()
        major, minor = torch.cuda.get_device_capability(device)
        self.capability = 10 * major + minor
        self._context = self._primary_context()
        self._build, self._guard = build, threading.Lock()
        self._modules: dict[int, ctypes.c_void_p] = {}
        self._functions: dict[tuple[str, int], ctypes.c_void_p] = {}
        self._module(variant)

    def _module(self, variant: int) -> ctypes.c_void_p:
        with self._guard:
            if variant not in self._modules:
                self._modules[variant] = self._loaded(self._build(self.capability, variant))
            return self._modules[variant]

    def _loaded(self, binary: Binary) -> ctypes.c_void_p:
        module = ctypes.c_void_p()
        with self._current():
            result = self._driver.cuModuleLoadData(ctypes.byref(module), binary.code)
        if result:
            raise NoCuda(
                f"the CUDA driver refuses kernels for {binary.architecture} made by NVRTC "
                f"{'.'.join(map(str, library().version))} ({self._words(result)}): update the NVIDIA driver"
            )
        return module

    def _function(self, kernel: str, variant: int) -> ctypes.c_void_p:
        key = (kernel, variant)
        if key not in self._functions:
            module, function = self._module(variant), ctypes.c_void_p()
            with self._current():
                self._check(self._driver.cuModuleGetFunction(ctypes.byref(function), module, kernel.encode()))
            self._functions[key] = function
        return self._functions[key]

    def launch(
        self, kernel: str, variant: int, grid: tuple[int, int], threads: int, argument: ctypes.Structure
    ) -> None:
        """Enqueue a kernel with one argument on torch's current stream; returns before it has run.

        Raises:
            D2Error: more blocks than a grid may have, or what the driver says.
            NoCuda: the variant cannot be compiled.
        """
        if 0 in grid:
            return
        if grid[0] > LARGEST_GRID[0] or grid[1] > LARGEST_GRID[1]:
            raise D2Error(
                f"a grid of {grid[0]} x {grid[1]} blocks, at most {LARGEST_GRID[0]} x {LARGEST_GRID[1]} can be "
                "launched: use fewer Gaussians or a smaller image"
            )
        function = self._function(kernel, variant)
        stream = ctypes.c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        parameters = (ctypes.c_void_p * 1)(ctypes.addressof(argument))
        with self._current():
            self._check(self._driver.cuLaunchKernel(function, *grid, 1, threads, 1, 1, 0, stream, parameters, None))

    def _primary_context(self) -> ctypes.c_void_p:
        torch.cuda.init()
        index, context = ctypes.c_int(), ctypes.c_void_p()
        self._check(self._driver.cuDeviceGet(ctypes.byref(index), self.device.index))
        self._check(self._driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), index))
        return context

    @contextlib.contextmanager
    def _current(self) -> Iterator[None]:
        """The device's context on this thread: one of autograd's may have none when a backward pass starts there."""
        self._check(self._driver.cuCtxPushCurrent_v2(self._context))
        try:
            yield
        finally:
            self._driver.cuCtxPopCurrent_v2(ctypes.byref(ctypes.c_void_p()))

    def _words(self, result: int) -> str:
        text = ctypes.c_char_p()
        self._driver.cuGetErrorName(result, ctypes.byref(text))
        return (text.value or b"unknown error").decode()

    def _check(self, result: int) -> None:
        if result:
            raise D2Error(f"the CUDA driver says {self._words(result)} on {self.device}: please report this")


def load_driver() -> ctypes.CDLL:
    """The driver's library.

    Raises:
        NoCuda: there is none, or it finds no GPU.
    """
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        driver = ctypes.CDLL(name)
    except OSError as error:
        raise NoCuda(f"the NVIDIA driver ({name}) was not found: install it, or use the CPU") from error
    if driver.cuInit(0):
        raise NoCuda("the NVIDIA driver finds no GPU: check `nvidia-smi`, or use the CPU")
    return driver

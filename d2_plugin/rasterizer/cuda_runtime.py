"""Launching the GPU kernels through the CUDA driver, by ctypes alone, in torch's context and on its streams."""

from __future__ import annotations

import contextlib
import ctypes
import sys
import threading
from collections.abc import Iterator

import torch

from d2_plugin.errors import D2Error

from .cuda_frame import THREADS, Frame
from .nvrtc import NoCuda, build, library

CACHED_CHANNELS = 3
"""Number of colors of the kernels that also run the survey, which needs no colors."""


class CudaLauncher:
    """Launches the kernels on one CUDA device, on torch's current stream (`cuda_frame.Launcher`)."""

    def __init__(self, device: torch.device) -> None:
        """Compile (or find) the kernels for `device` and load them.

        Raises:
            NoCuda: no driver, no NVRTC, or an architecture that it does not know.
        """
        if torch.version.hip:
            raise NoCuda(f"{device} is an AMD GPU, the kernels are for NVIDIA's: use the CPU")
        self.device = device
        self._driver = _load_driver()
        major, minor = torch.cuda.get_device_capability(device)
        self._capability = 10 * major + minor
        self._context = self._primary_context()
        self._functions: dict[tuple[str, int], ctypes.c_void_p] = {}
        self._modules: dict[int, ctypes.c_void_p] = {}
        self._guard = threading.Lock()
        self._module(CACHED_CHANNELS)

    def launch(self, kernel: str, blocks: int, frame: Frame, rows: int = 1) -> None:
        """See `Launcher.launch`; returns before the kernel has run."""
        if blocks == 0:
            return
        function = self._function(kernel, frame.channels or CACHED_CHANNELS)
        stream = ctypes.c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        parameters = (ctypes.c_void_p * 1)(ctypes.addressof(frame))
        with self._current():
            self._check(
                self._driver.cuLaunchKernel(function, blocks, rows, 1, THREADS, 1, 1, 0, stream, parameters, None)
            )

    def _function(self, kernel: str, channels: int) -> ctypes.c_void_p:
        key = (kernel, channels)
        if key not in self._functions:
            function = ctypes.c_void_p()
            module = self._module(channels)
            with self._current():
                self._check(self._driver.cuModuleGetFunction(ctypes.byref(function), module, kernel.encode()))
            self._functions[key] = function
        return self._functions[key]

    def _module(self, channels: int) -> ctypes.c_void_p:
        with self._guard:
            if channels not in self._modules:
                binary = build(self._capability, channels)
                module = ctypes.c_void_p()
                with self._current():
                    result = self._driver.cuModuleLoadData(ctypes.byref(module), binary.code)
                if result:
                    raise NoCuda(
                        f"the CUDA driver refuses kernels for {binary.architecture} made by NVRTC "
                        f"{'.'.join(map(str, library().version))} ({self._words(result)}): update the NVIDIA driver"
                    )
                self._modules[channels] = module
            return self._modules[channels]

    def _primary_context(self) -> ctypes.c_void_p:
        """The context that torch works in."""
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


def _load_driver() -> ctypes.CDLL:
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        driver = ctypes.CDLL(name)
    except OSError as error:
        raise NoCuda(f"the NVIDIA driver ({name}) was not found: install it, or use the CPU") from error
    if driver.cuInit(0):
        raise NoCuda("the NVIDIA driver finds no GPU: check `nvidia-smi`, or use the CPU")
    return driver

"""What a GPU needs to run our kernels, one part after the other, and what is missing of it: for `d2 doctor`."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import torch

from d2_plugin.compiler import driver, nvrtc

TORCH_FOR_CUDA = "https://pytorch.org/get-started"


def gpu_state() -> Iterator[tuple[str, str]]:
    """(part, its state) for the device, the driver and NVRTC; what is missing says what to do.

    A part whose predecessor is missing is told as well, since all must be mended before a GPU is used.
    """
    yield "device", _device()
    yield "driver", _driver()
    yield "NVRTC", _nvrtc()


def _device() -> str:
    if torch.version.hip:
        return f"torch {torch.__version__} is built for AMD GPUs, our kernels are for NVIDIA's: the CPU is used"
    if torch.version.cuda is None:
        return (
            f"CPU only: torch {torch.__version__} is built without CUDA; for a GPU install a build with CUDA "
            f"({TORCH_FOR_CUDA})"
        )
    if torch.cuda.is_available():
        major, minor = torch.cuda.get_device_capability()
        return f"{torch.cuda.get_device_name()} (sm_{major}{minor}), torch built for CUDA {torch.version.cuda}"
    return f"CPU only: no CUDA device found, though torch is built for CUDA {torch.version.cuda}"


def _driver() -> str:
    try:
        library = driver.load_driver()
    except nvrtc.NoCuda as error:
        return f"missing: {error}"
    known = ctypes.c_int()
    if library.cuDriverGetVersion(ctypes.byref(known)):
        return "found, but it does not tell its version: check `nvidia-smi`"
    version = (known.value // 1000, known.value % 1000 // 10)
    told = f"for CUDA {version[0]}.{version[1]}"
    if torch.version.cuda and int(torch.version.cuda.split(".")[0]) > version[0]:
        return f"{told}, but torch is built for CUDA {torch.version.cuda}: update the NVIDIA driver"
    return told


def _nvrtc() -> str:
    try:
        compiler = nvrtc.library()
        told = f"{compiler.version[0]}.{compiler.version[1]}"
        if torch.cuda.is_available():
            major, minor = torch.cuda.get_device_capability()
            told += f", compiles for {compiler.architecture_for(10 * major + minor)} at first use"
    except nvrtc.NoCuda as error:
        needed = torch.version.cuda is not None
        return (
            f"missing: {error}" if needed else "none, which only a GPU needs: builds of torch with CUDA bring it along"
        )
    return told

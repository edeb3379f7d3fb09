"""What `d2 doctor` tells a person with a GPU: each part that is missing, and what to do about it."""

import ctypes
from types import SimpleNamespace

import pytest
import torch

from d2_plugin.compiler import driver, nvrtc
from d2_plugin.compiler.gpu_state import gpu_state

NO_NVRTC = "NVRTC, which compiles the GPU kernels, was not found: run `pip install 'd2-4dgs[cuda]'`"


def machine(
    monkeypatch: pytest.MonkeyPatch,
    built_for: str | None = "13.0",
    driver_for: int | None = 13000,
    device: bool = True,
    compiler: bool = True,
) -> dict[str, str]:
    """The report on a machine like that."""

    def load_driver() -> SimpleNamespace:
        if driver_for is None:
            raise nvrtc.NoCuda("the NVIDIA driver (libcuda.so.1) was not found: install it, or use the CPU")
        return SimpleNamespace(cuDriverGetVersion=tell)

    def tell(number: ctypes.c_int) -> int:
        ctypes.cast(number, ctypes.POINTER(ctypes.c_int))[0] = driver_for
        return 0

    def library() -> SimpleNamespace:
        if not compiler:
            raise nvrtc.NoCuda(NO_NVRTC)
        return SimpleNamespace(version=(13, 0), architecture_for=lambda capability: f"sm_{capability}")

    monkeypatch.setattr(torch.version, "cuda", built_for)
    monkeypatch.setattr(torch.version, "hip", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Some GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(driver, "load_driver", load_driver)
    monkeypatch.setattr(nvrtc, "library", library)
    return dict(gpu_state())


HAS = {
    "device": "Some GPU (sm_90), torch built for CUDA 13.0",
    "driver": "for CUDA 13.0",
    "NVRTC": "13.0, compiles for sm_90 at first use",
}


@pytest.mark.parametrize(
    ("lacks", "says"),
    [
        ({}, HAS),
        ({"compiler": False}, {"NVRTC": f"missing: {NO_NVRTC}"}),
        (
            {"driver_for": 12040, "device": False},
            {"driver": "for CUDA 12.4, but torch is built for CUDA 13.0: update the NVIDIA driver"},
        ),
        (
            {"driver_for": None, "device": False},
            {
                "device": "no CUDA device found, though torch is built for CUDA 13.0",
                "driver": "missing: the NVIDIA driver (libcuda.so.1) was not found: install it, or use the CPU",
            },
        ),
        (
            {"built_for": None, "driver_for": None, "device": False, "compiler": False},
            {"device": f"torch {torch.__version__} is built without CUDA", "NVRTC": "bring it along"},
        ),
    ],
    ids=["nothing", "NVRTC", "a newer driver", "a driver", "a torch with CUDA"],
)
def test_what_a_machine_lacks_is_named_with_what_to_do(lacks: dict, says: dict[str, str], monkeypatch) -> None:
    report = machine(monkeypatch, **lacks)
    assert all(sentence in report[part] for part, sentence in says.items())
    assert report == HAS or lacks
    assert "https://pytorch.org" in report["device"] or "built_for" not in lacks

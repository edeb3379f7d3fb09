"""A GPU that is not there: tensors that say they lie on it and are computed on the CPU, and what it costs to wait.

Python sees `device == cuda:0`; torch itself sees the device `meta`, which it needs no driver for. Every operation is
dispatched here. What would make the host wait for the device is counted by the name of the operation: reading a number,
shapes that depend on data, and copies that do not ask to run beside the host. So are the bytes of every copy.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from d2_plugin.rasterizer import cuda

GPU, META = torch.device("cuda", 0), torch.device("meta")

WAITING = {
    "_local_scalar_dense", "equal", "is_nonzero", "nonzero", "masked_select", "_unique2", "unique_consecutive",
    "unique_dim", "bincount", "_linalg_check_errors", "linalg_inv", "linalg_solve", "linalg_cholesky", "isin",
}  # fmt: skip
"""Operations that wait on a GPU, besides copies, indices that are masks, and repeats of an unknown length."""


class OnGpu(Tensor):
    """A tensor whose numbers lie in `held` [CPU]."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> OnGpu:
        made = Tensor._make_wrapper_subclass(
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            device="meta", requires_grad=held.requires_grad,
        )  # fmt: skip
        made.held = held.detach()
        return made

    device = property(lambda self: GPU)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]
    is_meta = property(lambda self: False)  # type: ignore[assignment]

    def data_ptr(self) -> int:
        """Kernels of the shim run on the CPU."""
        return self.held.data_ptr()

    def tolist(self) -> Any:
        _mode().wait("tolist", self.held)
        return self.held.tolist()

    def __repr__(self, **_: Any) -> str:
        return f"OnGpu({self.held})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _mode().run(function, args, kwargs or {})


class CudaIsMeta(TorchFunctionMode):
    """What Python calls `cuda` is `meta` for torch's own code, which is built without CUDA where tests run."""

    def __torch_function__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        named = {name: _meta(value) for name, value in (kwargs or {}).items()}
        # Numbers from Python are made on the host and copied; torch leaves them out on `meta`.
        if function in (torch.tensor, torch.as_tensor) and named.pop("device", None) == META:
            return function(*args, **named).to(META)
        if function is Tensor.new_tensor and isinstance(args[0], OnGpu):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **named}).to(META)
        return function(*(args if function is torch.device else map(_meta, args)), **named)


def _meta(value: Any) -> Any:
    cuda_device = isinstance(value, (torch.device, str)) and str(value).startswith("cuda")
    return META if cuda_device else value


def _mapped(change: Callable[[Any], Any], value: Any) -> Any:
    """A value changed, or the lists, tuples and dicts of what it holds; torch's own way takes three times as long."""
    if isinstance(value, (list, tuple)):
        return type(value)([_mapped(change, part) for part in value])
    if isinstance(value, dict):
        return {name: _mapped(change, part) for name, part in value.items()}
    return change(value)


class FakeGpu(TorchDispatchMode):
    """While entered, `cuda` is this GPU; `waits` and `copied` count what `counting` encloses."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.copied: Counter[str] = Counter()
        self.where: Counter[str] = Counter()

    def wait(self, name: str, copied: Tensor | None = None) -> None:
        self.waits[name] += 1
        self.where[f"{name} in {_caller()}"] += 1
        if copied is not None:
            self.copied["to host"] += copied.numel() * copied.element_size()

    def __torch_dispatch__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return self.run(function, args, kwargs or {})

    def run(self, function: Any, args: tuple, kwargs: dict) -> Any:
        """Call an operation on the held numbers; its results are on the GPU if it is."""
        flat: list[Any] = []
        _mapped(flat.append, (args, kwargs))
        from_gpu = any(isinstance(part, OnGpu) for part in flat)
        asked = kwargs.get("device")
        to_gpu = asked is not None and torch.device(asked).type in ("cuda", "meta")
        name = function.overloadpacket.__name__
        if from_gpu:
            self._count(name, flat, args, kwargs, to_gpu)
        elif to_gpu and name == "_to_copy":
            self._count_upload(args[0], kwargs.get("non_blocking", False))
        elif name == "copy_" and isinstance(args[0], OnGpu):
            self._count_upload(args[1], args[2] if len(args) > 2 else False)
        out_of_gpu = from_gpu and name == "_to_copy" and asked is not None and not to_gpu
        plain = _mapped(lambda part: part.held if isinstance(part, OnGpu) else part, (args, kwargs))
        if to_gpu:
            plain[1]["device"] = torch.device("cpu")
        results = function(*plain[0], **plain[1])
        if out_of_gpu:
            return results
        mine = {id(part.held): part for part in flat if isinstance(part, OnGpu)}

        def placed(result: Any) -> Any:
            if not isinstance(result, Tensor) or not (from_gpu or to_gpu):
                return result
            return mine[id(result)] if id(result) in mine else OnGpu(result)

        return _mapped(placed, results)

    def _count(self, name: str, flat: list[Any], args: tuple, kwargs: dict, to_gpu: bool) -> None:
        filled = name.startswith("index_put") and args[2].numel() == 1  # torch fills where a mask is, without a wait
        masks = name in ("index", "index_put", "index_put_", "_index_put_impl_") and any(
            part is not None and part.dtype in (torch.bool, torch.uint8) and not filled for part in args[1]
        )
        if name == "repeat_interleave" and kwargs.get("output_size") is None:
            self.wait(name)
        elif name in WAITING or masks:
            self.wait(name if not masks else "mask as an index")
        elif name == "_to_copy" and kwargs.get("device") is not None and not to_gpu:
            self.wait("copy to the host", args[0])
        elif name == "copy_" and not isinstance(args[0], OnGpu):
            self.wait("copy to the host", args[1])
        elif name == "copy_" and not isinstance(args[1], OnGpu):
            self._count_upload(args[1], args[2] if len(args) > 2 else False)

    def _count_upload(self, source: Tensor, non_blocking: bool) -> None:
        self.copied["to device"] += source.numel() * source.element_size()
        if not non_blocking and source.ndim:
            self.wait("copy to the device")

    @contextmanager
    def counting(self) -> Iterator[FakeGpu]:
        self.waits.clear()
        self.copied.clear()
        self.where.clear()
        yield self


_modes: list[FakeGpu] = []


def _mode() -> FakeGpu:
    return _modes[-1]


def _caller() -> str:
    frame = sys._getframe(2)
    while frame is not None:
        name = frame.f_code.co_filename
        if "/torch/" not in name and not name.endswith("fake_gpu.py"):
            return f"{name.rsplit('/', 2)[-2]}/{name.rsplit('/', 1)[-1]}:{frame.f_lineno}"
        frame = frame.f_back
    return "?"


@pytest.fixture
def fake_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeGpu]:
    """The GPU, with the kernels of gpu.cu on it."""
    from splat_scenes import ShimLauncher, shim_library

    from d2_plugin.compiler import NoCompiler

    try:
        shim_library(3)
        shim_library(1)
    except NoCompiler as error:
        pytest.skip(str(error))
    launcher = ShimLauncher()
    monkeypatch.setattr(cuda, "launcher", lambda device: launcher)
    monkeypatch.setattr(cuda, "available", lambda device: True)
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(Tensor, "pin_memory", lambda self, *_: self)
    mode = FakeGpu()
    _modes.append(mode)
    with CudaIsMeta(), mode:
        yield mode
    _modes.pop()


def move(thing: Any, moved: dict[int, Any] | None = None) -> Any:
    """A tensor there, or an object all of whose tensors are: of its attributes, lists, modules and optimizers.

    Objects are changed, tensors are replaced, each by the same one wherever it is.
    """
    moved = {} if moved is None else moved
    if id(thing) in moved:
        return moved[id(thing)][1]
    if isinstance(thing, Tensor):
        there = OnGpu(thing.detach().clone())
        there = torch.nn.Parameter(there, thing.requires_grad) if isinstance(thing, torch.nn.Parameter) else there
        moved[id(thing)] = thing, there
        return there
    moved[id(thing)] = thing, thing
    if isinstance(thing, dict):
        for key, value in list(thing.items()):
            del thing[key]
            thing[move(key, moved) if isinstance(key, Tensor) else key] = move(value, moved)
    elif isinstance(thing, list):
        thing[:] = [move(value, moved) for value in thing]
    elif hasattr(thing, "__dict__") and not isinstance(thing, (type, ModuleType, FunctionType)):
        for name, value in list(vars(thing).items()):
            object.__setattr__(thing, name, move(value, moved))
    if isinstance(thing, FunctionType):
        for cell in thing.__closure__ or ():
            cell.cell_contents = move(cell.cell_contents, moved)
    return thing

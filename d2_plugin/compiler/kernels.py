"""The one way from Python to a C++ kernel: structures that its functions are given a pointer to, and its library."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from d2_plugin.compiler import NoCompiler, load_library

KINDS = {
    **{"int": ctypes.c_int32, "long": ctypes.c_int64, "unsigned": ctypes.c_uint32, "byte": ctypes.c_uint8},
    **{"float": ctypes.c_float, "double": ctypes.c_double, "pointer": ctypes.c_void_p},
}


class Call(ctypes.Structure):
    """What a kernel works on; pointers that nobody sets stay null."""

    def point(self, **arrays: Any) -> None:
        """Set pointers to contiguous arrays of numpy or tensors of torch, which the caller keeps alive."""
        for name, array in arrays.items():
            if array is not None:
                tensor = hasattr(array, "data_ptr")
                assert array.is_contiguous() if tensor else array.flags.c_contiguous, f"{name} is not contiguous"
                setattr(self, name, array.data_ptr() if tensor else array.ctypes.data)


def fields(*lines: str) -> list[tuple[str, Any]]:
    """Fields of a C structure, a kind and the names in their order in each line: "int width height", "float A[9]"."""
    found = []
    for kind, *names in map(str.split, lines):
        for name, _, length in (name.rstrip("]").partition("[") for name in names):
            found.append((name, KINDS[kind] * int(length) if length else KINDS[kind]))
    return found


def structure(*lines: str) -> type[Call]:
    """The C structure with these `fields`."""
    return type("Call", (Call,), {"_fields_": fields(*lines)})


def load_kernel(
    name: str,
    sources: Sequence[Path],
    headers: Sequence[Path],
    flags: Sequence[str],
    calls: Mapping[str, type[ctypes.Structure]],
    results: Mapping[str, Any],
    optional: bool = False,
) -> Any:
    """A library as `load_library` gives it, whose functions are known; ctypes.CDLL, or None.

    Args:
        name, sources, headers, flags: see `load_library`.
        calls: structures by name; `d2_NAME_size` of the source returns the size of each.
        results: what each function returns. d2_NAME takes a pointer to the structure of that name, others to the first.
        optional: None without a compiler, of which the rasterizer has warned already.

    Raises:
        NoCompiler, CompileError: see `load_library`.
    """
    try:
        kernel = load_library(name, sources, headers, flags)
    except NoCompiler:
        if optional:
            return None
        raise
    for call, kind in calls.items():
        size = getattr(kernel, f"d2_{call}_size")
        size.restype = ctypes.c_int64
        assert size() == ctypes.sizeof(kind), f"the structure {call} of {name} differs between Python and C++"
    for function, result in results.items():
        kind = calls.get(function[len("d2_") :], next(iter(calls.values())))
        getattr(kernel, function).argtypes, getattr(kernel, function).restype = (ctypes.POINTER(kind),), result
    return kernel

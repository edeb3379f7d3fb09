"""The compiled parts of the alignment and of the local correction (`kernels/`).

Compiled at first use; results are the same bits for any number of threads.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

from d2_plugin.compiler import NoCompiler, load_library

SOURCES = tuple(Path(__file__).parent / "kernels" / name for name in ("correct.cpp", "fit.cpp", "pixels.cpp"))
_STEREO = Path(__file__).parents[2] / "stereo" / "kernels"
_RASTERIZER = Path(__file__).parents[3] / "rasterizer" / "kernels"  # no import: only headers are shared
HEADERS = (_RASTERIZER / "parallel.h", *(_STEREO / name for name in ("lanes.h", "numbers.h")))
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none, and where its products have one it is written out."""


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernels; None without a compiler: NumPy then does the same.

    Raises:
        CompileError: see `d2_plugin.compiler.load_library`.
    """
    try:
        return load_library("monocular", SOURCES, HEADERS, FLAGS)
    except NoCompiler:
        return None


def run(name: str, call: ctypes.Structure) -> None:
    """Hand `call` to the function of that name.

    Raises:
        AssertionError: there is no library, or its structure is another.
    """
    _function(name, type(call))(ctypes.byref(call))


@functools.cache
def _function(name: str, structure: type[ctypes.Structure]) -> ctypes._FuncPointer:
    found = library()
    assert found is not None, "ask for the library first"
    size = getattr(found, f"d2_{name}_size")
    size.restype = ctypes.c_int64
    assert size() == ctypes.sizeof(structure), f"the call of {name} differs between Python and kernels/"
    function = getattr(found, f"d2_{name}")
    function.argtypes, function.restype = (ctypes.POINTER(structure),), None
    return function

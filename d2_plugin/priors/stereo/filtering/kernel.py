"""The compiled filter (`kernels/filter.cpp`, `kernels/precision.cpp`).

Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any number of them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler.kernels import load_kernel, structure

SOURCES = tuple(Path(__file__).parent / "kernels" / name for name in ("filter.cpp", "precision.cpp"))
_STEREO = Path(__file__).parents[1] / "kernels"
_RASTERIZER = Path(__file__).parents[3] / "rasterizer" / "kernels"  # no import: only its header is shared
HEADERS = (_RASTERIZER / "parallel.h", *(_STEREO / name for name in ("lanes.h", "numbers.h")))
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

CALLS = {
    "slopes": structure("int width height reach threads", "pointer depth inverse slope_x slope_y"),
    "coherence": structure(
        "int width height radius stride threads",
        "float relative",
        "pointer gray inverse slope_x slope_y weights share",
    ),
    "confirm": structure(
        "int width height their_width their_height between threads",
        "double A[9] k[3]",
        "float back_A[9] back_k[3] direction[3]",
        "double rays[9]",
        "float continuous reprojection_max relative_depth_max sine_min cosine_min sine_max cosine_max",
        "double nudge nudge_squared",
        "pointer depth theirs confirming information difference",
    ),
    "scatter": structure("int width height reach threads", "double slack", "pointer depth scatter"),
    "sigma": structure(
        "int width height threads",
        "float matching gray_noise flattest per_incoherence",
        "double of_scatter of_spread floor_squared",
        "pointer depth coherence gradient parallax spread scatter sigma",
    ),
}
"""d2::Slopes, Coherence and Confirm of kernels/filter.cpp, Scatter and Sigma of kernels/precision.cpp."""


@functools.cache
def library() -> Any:
    """The compiled kernel, or what `d2_plugin.compiler.load_library` raises: NoCompiler, CompileError."""
    return load_kernel("filter", SOURCES, HEADERS, FLAGS, CALLS, dict.fromkeys(f"d2_{name}" for name in CALLS))


def run(name: str, maps: Mapping[str, np.ndarray], **numbers: Any) -> None:
    """Call the function of that name of `CALLS`; results are written into contiguous arrays among `maps`.

    Args:
        maps: arrays by the pointer to them; `depth` or `inverse` [H, W] says the size.
        numbers: the other fields, small arrays as such.
    """
    call = CALLS[name](threads=torch.get_num_threads())
    call.height, call.width = maps["depth" if "depth" in maps else "inverse"].shape
    for field, value in numbers.items():
        if isinstance(value, np.ndarray):
            getattr(call, field)[:] = value.ravel().tolist()
        else:
            setattr(call, field, value)
    call.point(**maps)
    getattr(library(), f"d2_{name}")(call)

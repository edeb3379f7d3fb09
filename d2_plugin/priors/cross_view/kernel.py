"""Comparison of each mono-only pixel with the other views of its instant, compiled (`kernels/cross_view.cpp`).

Do the monocular maps of other cameras agree, and where does the pixel's ray meet a surface that another camera measured
by stereo? Compiled at first use; runs on `torch.get_num_threads()` threads, and results are the same bits for any
number of them.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler.kernels import load_kernel, structure
from d2_plugin.priors.geometry import CONTINUOUS, view_pair
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera

SOURCE = Path(__file__).parent / "kernels" / "cross_view.cpp"
HEADERS = (Path(__file__).parents[2] / "rasterizer" / "kernels" / "parallel.h",)  # no import: only its header is shared
FLAGS = ("-ffp-contract=off",)
"""No contraction: NumPy has none either."""

WITHIN = 1.2
"""A surface confirms a monocular depth within this many of its standard deviations; farther ones are often another."""
NEAR = 0.1
"""And within this relative difference, whatever is declared."""
BESIDE = 0.03
"""Share of the step to the surface that may remain as error."""
LIKE = 0.04
"""Largest difference of the colours (0..1, mean of 3x3 pixels) of one place in two images. A ray that passes a near
thing which the map does not know meets the surface behind it, which mostly has another colour."""
DARK = 20
"""Of 255: a darker pixel does not tell how differently two cameras are exposed."""
FEWEST = 100
"""Fewer pixels than this that both verified do not tell it either."""
ONE_PLACE = 0.02
"""Nor does a pixel whose depth in the other view is off by more, in log depth."""
COMPARED = 8000
"""About how many verified pixels are compared for it, evenly over the image."""
STEPS = 3
"""Secant steps along the ray."""
NUDGE = 1.001
"""Factor of depth between the two points of a secant."""
FLATTEST = 0.2
"""Where the miss changes by less per log depth, the surface runs along the ray."""
LONGEST = 0.2
"""Longest step, in log depth."""
MET = 3e-3
"""The ray has met the surface when their depths differ by less than this share."""
MISSED = 0.5
"""A ray that misses by more, in log depth, is not followed."""
OVERSHOT = 2.0
"""Nor is one whose first step is so many times farther than allowed."""


@dataclass(frozen=True, eq=False)
class View:
    """One view of an instant; contiguous maps [H, W]."""

    labels: np.ndarray
    """`Label`, uint8."""
    depth: np.ndarray
    """float32."""
    log: np.ndarray
    """Logarithm of the depth, float32; infinite where there is none."""
    sigma: np.ndarray
    """float32."""
    colors: np.ndarray | None
    """Mean of 3x3 pixels, uint8 [H, W, 3]; None where there is no image."""


_View = structure(
    "int width height", "double agreeing", "pointer labels depth log sigma colors new_labels new_depth new_sigma"
)
_Pair = structure("double A[9] k[3]", "float gain[3]")
_Instant = structure(
    "int count threads compared steps fewest",
    "float continuous like dark",
    "double tolerance at_best alone one_place within near beside",
    "double nudge log_nudge flattest longest met missed overshot",
    "byte label_mono label_agreed label_verified",
    "pointer views pairs",
)
"""d2::View, Pair and Instant of kernels/cross_view.cpp."""

_NUMBERS = {
    "continuous": CONTINUOUS,
    "like": LIKE * 255,
    "dark": DARK,
    "compared": COMPARED,
    "steps": STEPS,
    "fewest": FEWEST,
    "one_place": ONE_PLACE,
    "within": WITHIN,
    "near": NEAR,
    "beside": BESIDE,
    "nudge": NUDGE,
    "log_nudge": float(np.log(NUDGE)),
    "flattest": FLATTEST,
    "longest": LONGEST,
    "met": MET,
    "missed": MISSED,
    "overshot": OVERSHOT,
    "label_mono": int(Label.MONO),
    "label_agreed": int(Label.AGREED),
    "label_verified": int(Label.VERIFIED),
}


@functools.cache
def library() -> Any:
    """The compiled kernel, or what `d2_plugin.compiler.load_library` raises: NoCompiler, CompileError."""
    calls = {"instant": _Instant, "pair": _Pair, "view": _View}
    return load_kernel("cross_view", (SOURCE,), HEADERS, FLAGS, calls, {"d2_compare_views": None})


def compare_views(
    views: Mapping[str, View],
    cameras: Mapping[str, Camera],
    agreeing: Mapping[str, float],
    numbers: Mapping[str, float],
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(labels, depth, sigma) of each view after its mono-only pixels were compared with all others (`with_evidence`).

    Args:
        agreeing: by camera, the factor of sigma where another map agrees.
        numbers: `tolerance` in log depth, the factor of sigma `alone`, and `at_best`.
    """
    count = len(views)
    changed = {name: (view.labels.copy(), view.depth.copy(), view.sigma.copy()) for name, view in views.items()}
    given = (_View * count)(*(_view(view, changed[name], agreeing[name]) for name, view in views.items()))
    pairs = (_Pair * count**2)(*(_pair(cameras[ours], cameras[theirs]) for ours in views for theirs in views))
    call = _Instant(**_NUMBERS, **numbers, count=count, threads=torch.get_num_threads())
    call.views, call.pairs = ctypes.addressof(given), ctypes.addressof(pairs)
    library().d2_compare_views(call)
    return changed


def _view(view: View, changed: tuple[np.ndarray, np.ndarray, np.ndarray], agreeing: float) -> Any:
    call = _View(agreeing=agreeing)
    call.height, call.width = view.labels.shape
    call.point(**vars(view), **dict(zip(("new_labels", "new_depth", "new_sigma"), changed)))
    return call


def _pair(ours: Camera, theirs: Camera) -> Any:
    pair = view_pair(ours, theirs)
    return _Pair(A=tuple(pair.A.ravel().tolist()), k=tuple(pair.k.tolist()), gain=(1, 1, 1))

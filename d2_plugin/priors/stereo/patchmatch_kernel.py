"""The compiled kernels of PatchMatch (`kernels/patchmatch.cpp`), called with views of one resolution."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.compiler import load_library
from d2_plugin.compiler.kernels import Call, structure
from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import index_intrinsics, view_pair
from d2_plugin.priors.stereo.pyramid import NO_MATCH, LevelView
from d2_plugin.priors.stereo.settings import StereoSettings

KERNELS = Path(__file__).parent / "kernels"
FLAGS = ("-fopenmp-simd", "-ffp-contract=off")
"""No contraction: the kernels say themselves what is fused, so that all devices return the same bits."""

SOURCES = [KERNELS / "patchmatch.cpp"]
HEADERS = tuple(KERNELS / name for name in ("numbers.h", "planes.h", "matching.h", "spread.h"))
ON_CPU = (KERNELS / "lanes.h", KERNELS.parents[2] / "rasterizer" / "kernels" / "parallel.h")  # no import: shared alone

MOST_PIXELS = 2**31 - 1
"""Of all sources together: their places are 32-bit integers."""

CONTRAST = 0.08
"""Standard deviation of the bilateral weight over grey values in a matching window, in 0..1."""
CONSENSUS_PASSES = 2
"""How often each plane is averaged with those of its neighbours that agree with it."""
CONSENSUS_RADIUS = 3
"""Half the side of the window over which planes are averaged, pixels."""
CONSENSUS_TOLERANCE = 0.02
"""Neighbouring planes agree when they pass within this share of the inverse depth."""

Source = structure("int width height first", "float A[9] k[3]")
"""d2::Source of kernels/matching.h: a view as the reference sees it."""

Task = structure(
    "float intrinsics[4]",
    "int width height source_count rounds draw_planes explore threads",
    "unsigned seed",
    "float inverse_far inverse_near per_gray",
    "pointer gray wanted sources quads planes costs views",
)
"""d2::Task of kernels/spread.h: what the planes of one reference view spread by."""

Arrays = dict[str, np.ndarray]
"""What the pointers of a task point to, by their names."""


class PatchMatchKernel:
    """The compiled kernels with what stays the same for all views and levels.

    Args:
        sources: per view, the numbers of the views it is matched with; 32 at most, one bit each in the kernel's mask.
        depth_range: near and far in world units.
        settings: `seed`.

    Raises:
        NoCompiler: there is no C++ compiler.
    """

    def __init__(self, sources: list[list[int]], depth_range: tuple[float, float], settings: StereoSettings) -> None:
        self.sources, self.depth_range, self.settings = sources, depth_range, settings
        self._start()

    def _start(self) -> None:
        self.library = load_library("patchmatch", SOURCES, HEADERS + ON_CPU, FLAGS)

    def match(self, views: Sequence[LevelView], index: int, stage: int, rounds: int, explore: bool) -> None:
        """Improve the planes of one view in place, after drawing them at stage 0; writes its cost.

        `stage` also seeds the random numbers, so that calls for the same view draw different ones.
        """
        if not self.sources[index]:
            return
        view = views[index]
        task = self._task(view)
        task.rounds, task.draw_planes, task.explore = rounds, stage == 0, explore
        task.seed = int(np.random.SeedSequence([self.settings.seed, stage, index]).generate_state(1)[0])
        arrays = self._view_arrays(view)
        arrays["views"] = np.zeros(view.gray.shape, np.uint32)
        arrays |= self._source_arrays(view, [views[other] for other in self.sources[index]])
        task.source_count = len(self.sources[index])
        self._spread(task, arrays)
        view.known |= view.cost < NO_MATCH

    def average(self, view: LevelView) -> None:
        """Replace each plane by the mean of those around it that agree with it."""
        view.planes = self._average(self._task(view), self._view_arrays(view))

    def _spread(self, task: Call, arrays: Arrays) -> None:
        """Let planes spread; writes the arrays `planes` and `costs`."""
        task.point(**arrays)
        self.library.d2_patchmatch(ctypes.byref(task))

    def _average(self, task: Call, arrays: Arrays) -> np.ndarray:
        """The planes after all passes of the consensus."""
        tolerance = ctypes.c_float(CONSENSUS_TOLERANCE)
        planes, averaged = arrays["planes"], np.empty_like(arrays["planes"])
        for _ in range(CONSENSUS_PASSES):
            task.point(**arrays | {"planes": planes})
            written = ctypes.c_void_p(averaged.ctypes.data)
            self.library.d2_consensus(ctypes.byref(task), CONSENSUS_RADIUS, tolerance, written)
            planes, averaged = averaged, np.empty_like(planes)
        return planes

    def _task(self, view: LevelView) -> Any:
        """What is the same of all calls for one view of one resolution."""
        (near, far), K = self.depth_range, index_intrinsics(view.camera)
        return Task(
            intrinsics=(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            width=view.gray.shape[1],
            height=view.gray.shape[0],
            threads=torch.get_num_threads(),
            inverse_far=1 / far,
            inverse_near=1 / near,
            per_gray=-0.5 * math.log2(math.e) / (255 * CONTRAST) ** 2,  # log2 of the weight per squared difference
        )

    def _view_arrays(self, view: LevelView) -> Arrays:
        arrays = {"gray": view.gray, "planes": view.planes, "costs": view.cost}
        return arrays if view.wanted is None else arrays | {"wanted": view.wanted}

    def _source_arrays(self, view: LevelView, chosen: Sequence[LevelView]) -> Arrays:
        first = np.cumsum([0, *(source.gray.size for source in chosen)])
        if first[-1] > MOST_PIXELS:
            raise D2Error(
                f"the images that a view is matched with have {first[-1]} pixels together, at most {MOST_PIXELS} are "
                "possible: lower max_pixels"
            )
        sources = (Source * len(chosen))(*(_source(view, *pair) for pair in zip(chosen, first.tolist())))
        quads = np.concatenate([source.quads.ravel() for source in chosen])
        return {"sources": np.frombuffer(bytes(sources), np.uint8), "quads": quads}


def _source(reference: LevelView, source: LevelView, first: int) -> Any:
    pair = view_pair(reference.camera, source.camera)
    return Source(source.camera.width, source.camera.height, first, tuple(pair.A.ravel()), tuple(pair.k))

"""The compiled kernels of PatchMatch (`kernels/patchmatch.cpp`), called with views of one resolution."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.captures.capture import Camera
from d2_plugin.compiler import load_library
from d2_plugin.priors.geometry import index_intrinsics, view_pair
from d2_plugin.priors.stereo.pyramid import NO_MATCH, LevelView
from d2_plugin.priors.stereo.settings import StereoSettings

KERNELS = Path(__file__).parent / "kernels"
FLAGS = ("-fopenmp-simd", "-ffp-contract=off")
"""No contraction: the kernels say themselves what is fused, so that all devices return the same bits."""

HEADERS = [KERNELS / name for name in ("numbers.h", "lanes.h", "planes.h", "matching.h", "spread.h")]

CONSENSUS_RADIUS = 3
"""Half the side of the window over which planes are averaged, pixels."""


_float, _int, _pointer = ctypes.c_float, ctypes.c_int32, ctypes.c_void_p


class Source(ctypes.Structure):
    """d2::Source of kernels/matching.h: a view as the reference sees it."""

    _fields_ = (
        *((name, _int) for name in ("width", "height", "first")),
        ("A", _float * 9),
        ("k", _float * 3),
        ("back_A", _float * 9),
        ("back_k", _float * 3),
    )


class Task(ctypes.Structure):
    """d2::Task of kernels/spread.h: what the planes of one reference view spread by."""

    _fields_ = (
        ("intrinsics", _float * 4),
        *((name, _int) for name in ("width", "height", "source_count", "rounds", "draw_planes", "explore", "threads")),
        ("seed", ctypes.c_uint32),
        *((name, _float) for name in ("inverse_far", "inverse_near", "per_gray", "geometric_weight")),
        *(
            (name, _pointer)
            for name in ("gray", "wanted", "sources", "quads", "depths", "planes", "costs", "views")
        ),
    )


class PatchMatchKernel:
    """The compiled kernels with what stays the same for all views and levels.

    Args:
        sources: per view, the numbers of the views it is matched with; 32 at most, one bit each in the kernel's mask.
        depth_range: near and far in world units.
        settings: the `patchmatch_*` fields and `seed`.

    Raises:
        NoCompiler: there is no C++ compiler.
    """

    def __init__(self, sources: list[list[int]], depth_range: tuple[float, float], settings: StereoSettings) -> None:
        self.sources = sources
        self.depth_range = depth_range
        self.settings = settings
        self.library = load_library("patchmatch", [KERNELS / "patchmatch.cpp"], HEADERS, FLAGS)

    def match(
        self,
        views: Sequence[LevelView],
        index: int,
        stage: int,
        rounds: int,
        explore: bool,
        depths: Sequence[np.ndarray] | None = None,
    ) -> None:
        """Improve the planes of one view in place, after drawing them at stage 0; writes its cost.

        `stage` also tells apart the random numbers of calls for the same view. With `depths`, a map per view, planes
        are asked to agree with them as well.
        """
        view, sources = views[index], self.sources[index]
        if not sources:
            return
        task, _kept_alive = self.task(views, index, stage, rounds, explore, depths)
        self.library.d2_patchmatch(ctypes.byref(task))
        view.known |= view.cost < NO_MATCH

    def task(
        self,
        views: Sequence[LevelView],
        index: int,
        stage: int,
        rounds: int,
        explore: bool,
        depths: Sequence[np.ndarray] | None,
    ) -> tuple[Task, list[Any]]:
        """What the kernel is given, and what must outlive its call."""
        view, chosen = views[index], [views[other] for other in self.sources[index]]
        first = np.cumsum([0, *(source.gray.size for source in chosen)])
        sources = (Source * len(chosen))(*(_source(view, *pair) for pair in zip(chosen, first.tolist())))
        quads = np.concatenate([source.quads.ravel() for source in chosen])
        selected = np.zeros(view.gray.shape, np.uint32)
        asked = None
        if depths is not None:
            asked = np.concatenate([depths[other].ravel() for other in self.sources[index]])
        near, far = self.depth_range
        task = Task(
            intrinsics=_intrinsics(view.camera),
            width=view.gray.shape[1],
            height=view.gray.shape[0],
            source_count=len(chosen),
            rounds=rounds,
            draw_planes=stage == 0,
            explore=explore,
            threads=torch.get_num_threads(),
            seed=int(np.random.SeedSequence([self.settings.seed, stage, index]).generate_state(1)[0]),
            inverse_far=1 / far,
            inverse_near=1 / near,
            per_gray=per_squared_gray(self.settings),
            geometric_weight=0 if depths is None else self.settings.patchmatch_geometric_weight,
            gray=view.gray.ctypes.data,
            wanted=None if view.wanted is None else view.wanted.ctypes.data,
            sources=ctypes.cast(sources, _pointer),
            quads=quads.ctypes.data,
            depths=None if asked is None else asked.ctypes.data,
            planes=view.planes.ctypes.data,
            costs=view.cost.ctypes.data,
            views=selected.ctypes.data,
        )
        return task, [sources, quads, asked, selected]

    def average(self, view: LevelView) -> None:
        """Replace each plane by the mean of those around it that agree with it."""
        for _ in range(self.settings.patchmatch_consensus_passes):
            averaged = np.empty_like(view.planes)
            task = Task(
                width=view.gray.shape[1],
                height=view.gray.shape[0],
                threads=torch.get_num_threads(),
                per_gray=per_squared_gray(self.settings),
                gray=view.gray.ctypes.data,
                wanted=None if view.wanted is None else view.wanted.ctypes.data,
                planes=view.planes.ctypes.data,
            )
            tolerance = _float(self.settings.patchmatch_consensus_tolerance)
            self.library.d2_consensus(ctypes.byref(task), CONSENSUS_RADIUS, tolerance, _pointer(averaged.ctypes.data))
            view.planes = averaged


def per_squared_gray(settings: StereoSettings) -> float:
    """log2 of the bilateral weight per squared grey difference, grey values in 0..255 (`sample_weight`)."""
    return -0.5 * math.log2(math.e) / (255 * settings.patchmatch_contrast) ** 2


def _intrinsics(camera: Camera) -> ctypes.Array:
    K = index_intrinsics(camera)
    return (_float * 4)(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def _source(reference: LevelView, source: LevelView, first: int) -> Source:
    forth, back = view_pair(reference.camera, source.camera), view_pair(source.camera, reference.camera)
    nine, three = _float * 9, _float * 3
    return Source(
        source.camera.width,
        source.camera.height,
        first,
        nine(*forth.A.ravel()),
        three(*forth.k),
        nine(*back.A.ravel()),
        three(*back.k),
    )

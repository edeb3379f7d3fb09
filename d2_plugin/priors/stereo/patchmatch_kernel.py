"""The compiled kernels of PatchMatch (`kernels/patchmatch.cpp`), called with views of one resolution."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from d2_plugin.captures.capture import Camera
from d2_plugin.compiler import load_library
from d2_plugin.priors.geometry import index_intrinsics, view_pair
from d2_plugin.priors.stereo.pyramid import NO_MATCH, LevelView
from d2_plugin.priors.stereo.settings import StereoSettings

KERNELS = Path(__file__).parent / "kernels"
FLAGS = ("-fopenmp-simd", "-ffp-contract=fast")

CONSENSUS_RADIUS = 3
"""Half the side of the window over which planes are averaged, pixels."""


class _Picture(ctypes.Structure):
    _fields_ = (("width", ctypes.c_int32), ("height", ctypes.c_int32), ("gray", ctypes.c_void_p))


class _Source(ctypes.Structure):
    _fields_ = (
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("quads", ctypes.c_void_p),
        ("A", ctypes.c_float * 9),
        ("k", ctypes.c_float * 3),
        ("back_A", ctypes.c_float * 9),
        ("back_k", ctypes.c_float * 3),
        ("depth", ctypes.c_void_p),
    )


class _Task(ctypes.Structure):
    _fields_ = (
        ("reference", _Picture),
        ("intrinsics", ctypes.c_float * 4),
        ("source_count", ctypes.c_int32),
        ("sources", ctypes.POINTER(_Source)),
        ("inverse_far", ctypes.c_float),
        ("inverse_near", ctypes.c_float),
        ("contrast", ctypes.c_float),
        ("geometric_weight", ctypes.c_float),
        ("rounds", ctypes.c_int32),
        ("draw_planes", ctypes.c_int32),
        ("explore", ctypes.c_int32),
        ("threads", ctypes.c_int32),
        ("seed", ctypes.c_uint32),
        ("wanted", ctypes.c_void_p),
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
        headers = [KERNELS / "planes.h", KERNELS / "matching.h"]
        self.library = load_library("patchmatch", [KERNELS / "patchmatch.cpp"], headers, FLAGS)

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
        near, far = self.depth_range
        found = [_source(view, views[other], None if depths is None else depths[other]) for other in sources]
        task = _Task(
            _picture(view.gray),
            _intrinsics(view.camera),
            len(sources),
            (_Source * len(sources))(*found),
            1 / far,
            1 / near,
            self.settings.patchmatch_contrast,
            0 if depths is None else self.settings.patchmatch_geometric_weight,
            rounds,
            stage == 0,
            explore,
            torch.get_num_threads(),
            int(np.random.SeedSequence([self.settings.seed, stage, index]).generate_state(1)[0]),
            None if view.wanted is None else view.wanted.ctypes.data,
        )
        chosen = np.zeros(view.gray.shape, np.uint32)
        self.library.d2_patchmatch(ctypes.byref(task), _pointer(view.planes), _pointer(view.cost), _pointer(chosen))
        view.known |= view.cost < NO_MATCH

    def average(self, view: LevelView) -> None:
        """Replace each plane by the mean of those around it that agree with it."""
        picture = _picture(view.gray)
        for _ in range(self.settings.patchmatch_consensus_passes):
            averaged = np.empty_like(view.planes)
            self.library.d2_consensus(
                ctypes.byref(picture),
                ctypes.c_float(self.settings.patchmatch_contrast),
                CONSENSUS_RADIUS,
                ctypes.c_float(self.settings.patchmatch_consensus_tolerance),
                torch.get_num_threads(),
                None if view.wanted is None else _pointer(view.wanted),
                _pointer(view.planes),
                _pointer(averaged),
            )
            view.planes = averaged


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _picture(gray: np.ndarray) -> _Picture:
    return _Picture(gray.shape[1], gray.shape[0], gray.ctypes.data)


def _intrinsics(camera: Camera) -> ctypes.Array:
    K = index_intrinsics(camera)
    return (ctypes.c_float * 4)(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def _source(reference: LevelView, source: LevelView, depth: np.ndarray | None) -> _Source:
    forth, back = view_pair(reference.camera, source.camera), view_pair(source.camera, reference.camera)
    nine, three = ctypes.c_float * 9, ctypes.c_float * 3
    return _Source(
        source.camera.width,
        source.camera.height,
        source.quads.ctypes.data,
        nine(*forth.A.ravel()),
        three(*forth.k),
        nine(*back.A.ravel()),
        three(*back.k),
        None if depth is None else depth.ctypes.data,
    )

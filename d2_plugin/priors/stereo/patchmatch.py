"""PatchMatch multi-view stereo on the CPU, compiled at first use: geometric depth without a GPU.

Each pixel carries a plane, linear in inverse depth over the picture, and keeps the best of what it draws at random and
of what its neighbours found (`kernels/patchmatch.cpp`). Resolution doubles from level to level, and planes are carried
over exactly. In the end each plane has fitted the noise of its own window; averaging those that agree takes that out.
Coordinates are array indices, as in `d2_plugin.priors.geometry`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from d2_plugin.captures.capture import Camera
from d2_plugin.compiler import load_library
from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import (
    check_depth_range,
    check_views,
    index_intrinsics,
    pixel_grid,
    scaled_camera,
    triangulation_angle,
    view_pair,
)
from d2_plugin.priors.settings import StereoSettings

KERNELS = Path(__file__).parent / "kernels"
FLAGS = ("-fopenmp-simd", "-ffp-contract=fast")

NO_MATCH = 2.0
"""Worst matching cost; such a pixel has no depth."""

MAX_SOURCES = 32
"""Of the kernel: one bit each in a mask."""

SMALLEST_SIDE = 12
"""Levels whose shorter side would have fewer pixels than this are skipped: an 11-pixel window must fit."""

CONSENSUS_RADIUS = 3
"""Half the side of the window over which planes are averaged, pixels."""

GEOMETRIC_SWEEPS = 1
"""Red-black sweeps of one geometric round; a second one costs as much and changes mean F at 1 % by less than .001."""

BEST_ANGLE = 10.0
"""Angle between viewing rays, degrees, that sources are preferred for: wider ones match worse, narrower ones tell
less (MVSNet prefers 5 and tolerates up to 15)."""


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


@dataclass(eq=False)
class _View:
    """One camera at one resolution, with what has been found there so far."""

    camera: Camera
    gray: np.ndarray  # uint8 [H, W]
    quads: np.ndarray  # uint32 [H, W]
    planes: np.ndarray  # float32 [H, W, 3]
    known: np.ndarray  # bool [H, W], whether anything matched here, at this or a coarser resolution
    cost: np.ndarray  # float32 [H, W]
    wanted: np.ndarray | None  # bool [H, W], where a match is asked for; everywhere where None


def patchmatch(
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings | None = None,
    wanted: Sequence[np.ndarray] | None = None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and matching cost of every view from the others, before any filter.

    Uses `torch.get_num_threads()` threads; the result does not depend on their number, and `settings.seed` repeats it.

    Args:
        grays: uint8 [H, W] per camera, synchronized.
        cameras: at least two, in the same order.
        depth_range: near and far in world units; ten times too wide does no harm.
        settings: the `patchmatch_*` fields, `min_angle`, `max_angle` and `seed` are used; defaults where None.
        wanted: bool [H, W] per camera, pixels whose depth is asked for; all where None. Others may have no depth.

    Returns:
        Per camera: planar depth float32 [H, W] (0 where nothing matches) and 1 - NCC float32 [H, W] in 0..2. A view
        that no other one meets at an angle has no depth anywhere.

    Raises:
        D2Error: fewer than two views, a picture of another size or type, an inverted depth range, no level.
        NoCompiler: there is no C++ compiler; `d2_plugin.priors.stereo.sweep` needs none.
    """
    settings = settings or StereoSettings()
    check_views(grays, cameras)
    near, far = check_depth_range(depth_range)
    _check(grays, settings)
    sources = [choose_sources(index, cameras, (near, far), settings) for index in range(len(cameras))]
    matcher = _Matcher(sources, (near, far), settings)
    masks = wanted or [None] * len(cameras)
    views: list[_View] = []
    for level, (divisor, rounds) in enumerate(_levels(cameras, settings.patchmatch_rounds)):
        coarser = views or [None] * len(cameras)
        views = [_at_resolution(*view, divisor) for view in zip(grays, cameras, coarser, masks)]
        for index in range(len(views)):
            # Once planes are handed down from a coarser level, random ones are hardly ever better.
            matcher.match(views, index, level, rounds, explore=divisor > 1 or level == 0)
    for extra in range(settings.patchmatch_geometric_rounds):
        depths = [_depth(view) for view in views]
        for index in range(len(views)):
            matcher.match(views, index, 100 + extra, GEOMETRIC_SWEEPS, explore=False, depths=depths)
    for view in views:
        matcher.average(view)
    return [(_depth(view), view.cost) for view in views]


def choose_sources(
    index: int, cameras: Sequence[Camera], depth_range: tuple[float, float], settings: StereoSettings
) -> list[int]:
    """Which other cameras view `index` is matched with, best first, at most `settings.patchmatch_sources`.

    Points of the view frustum are tried: a source counts for each point that it sees at an angle between `min_angle`
    and `max_angle`, the more the nearer (by ratio) that angle is to `BEST_ANGLE`. Outside of them the filter confirms
    nothing, so a camera at the same place or one that looks from the other side is never matched.
    """
    grid = scaled_camera(cameras[index], 12, 8)
    u, v = pixel_grid(grid)
    worth = {}
    for other, source in enumerate(cameras):
        if other == index:
            continue
        pair = view_pair(grid, source)
        worth[other] = 0.0
        for inverse in np.linspace(1 / depth_range[1], 1 / depth_range[0], 8):
            depth = np.full((grid.height, grid.width), 1 / inverse, np.float32)
            at = pair.project(u, v, depth)
            seen = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < source.width) & (at.y < source.height)
            angle = np.rad2deg(triangulation_angle(grid, pair, depth))
            useful = seen & (angle > settings.min_angle) & (angle < settings.max_angle)
            ratio = np.log(np.where(useful, angle, BEST_ANGLE) / BEST_ANGLE) / np.log(3)
            worth[other] += float((useful * np.exp(-0.5 * ratio**2)).sum())
    ranked = sorted((other for other in worth if worth[other] > 0), key=lambda other: -worth[other])
    return ranked[: settings.patchmatch_sources]


class _Matcher:
    """The compiled kernels with what stays the same for all views and levels."""

    def __init__(self, sources: list[list[int]], depth_range: tuple[float, float], settings: StereoSettings) -> None:
        self.sources = sources
        self.depth_range = depth_range
        self.settings = settings
        headers = [KERNELS / "planes.h", KERNELS / "matching.h"]
        self.library = load_library("patchmatch", [KERNELS / "patchmatch.cpp"], headers, FLAGS)

    def match(
        self,
        views: Sequence[_View],
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
        task = _Task(
            _picture(view.gray),
            _intrinsics(view.camera),
            len(sources),
            (_Source * len(sources))(*(_source(view, views[other], depths and depths[other]) for other in sources)),
            1 / far,
            1 / near,
            self.settings.patchmatch_contrast,
            self.settings.patchmatch_geometric_weight if depths else 0,
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

    def average(self, view: _View) -> None:
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


def _check(grays: Sequence[np.ndarray], settings: StereoSettings) -> None:
    for gray in grays:
        if gray.dtype != np.uint8 or gray.ndim != 2:
            raise D2Error(
                f"PatchMatch needs grey pictures as uint8 [H, W], got {gray.dtype} with {gray.ndim} dimensions: "
                f"convert them with d2_plugin.priors.stereo.geometric_depth.gray"
            )
    rounds, sources = settings.patchmatch_rounds, settings.patchmatch_sources
    if not rounds or min(rounds) < 0 or not 1 <= sources <= MAX_SOURCES:
        raise D2Error(
            f"PatchMatch needs at least one level, no negative number of rounds and 1 to {MAX_SOURCES} sources, got "
            f"patchmatch_rounds {tuple(rounds)} and patchmatch_sources {sources}"
        )


def _levels(cameras: Sequence[Camera], rounds: Sequence[int]) -> list[tuple[int, int]]:
    """(divisor of the resolution, rounds) from coarse to fine, without levels too small for a window."""
    side = min(min(camera.width, camera.height) for camera in cameras)
    levels = [(2 ** (len(rounds) - 1 - number), count) for number, count in enumerate(rounds)]
    return [(divisor, count) for divisor, count in levels if divisor == 1 or side // divisor >= SMALLEST_SIDE]


def _at_resolution(
    gray: np.ndarray, camera: Camera, coarser: _View | None, wanted: np.ndarray | None, divisor: int
) -> _View:
    """The view with `divisor` times fewer pixels each way, and the planes of the coarser one if there is one."""
    if divisor > 1:
        camera = scaled_camera(camera, round(camera.width / divisor), round(camera.height / divisor))
        pixels = torch.from_numpy(np.ascontiguousarray(gray))[None, None].to(torch.float32)
        smaller = torch.nn.functional.interpolate(pixels, (camera.height, camera.width), mode="area")
        gray = smaller[0, 0].round().to(torch.uint8).numpy()
    gray = np.ascontiguousarray(gray)
    cost = np.full(gray.shape, NO_MATCH, np.float32)
    if coarser is None:
        planes, known = np.zeros((*gray.shape, 3), np.float32), np.zeros(gray.shape, bool)
    else:
        planes, known = refined_planes(coarser.planes, gray.shape), _nearest(coarser.known, gray.shape)
    mask = None if wanted is None else _any_within(wanted, gray.shape)
    return _View(camera, gray, _quads(gray), planes, known, cost, mask)


def _any_within(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Coarse pixels of `shape` from which any pixel of a finer mask takes its plane, bool."""
    rows, columns = _parents(shape, mask.shape)
    y, x = np.nonzero(mask)
    coarse = np.zeros(shape, bool)
    coarse[rows[y], columns[x]] = True
    return coarse


def refined_planes(planes: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Planes [h, w, 3] of a coarse picture as planes [H, W, 3] of a finer one: the same planes in space, exactly.

    The centre of fine pixel u is at s (u + 1/2) - 1/2 in coarse indices, s = w / W, so a u' + b v' + c stays linear.
    """
    scale_v, scale_u = (coarse / fine for coarse, fine in zip(planes.shape[:2], shape))
    a, b, c = np.moveaxis(_nearest(planes, shape), -1, 0)
    offset = c + a * (scale_u - 1) / 2 + b * (scale_v - 1) / 2
    return np.ascontiguousarray(np.stack([a * scale_u, b * scale_v, offset], axis=-1), dtype=np.float32)


def _nearest(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """`values` [h, w, ...] at [H, W], each fine pixel taking what the coarse pixel around its centre has."""
    rows, columns = _parents(values.shape[:2], shape)
    return values[rows][:, columns]


def _parents(coarse: tuple[int, int], fine: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the coarse pixel around the centre of each fine row and column."""
    rows, columns = (((np.arange(to) + 0.5) * (of / to)).astype(np.int64) for of, to in zip(coarse, fine))
    return rows, columns


def _depth(view: _View) -> np.ndarray:
    """Planar depth float32 [H, W] of the planes; 0 where nothing matched.

    Where only a coarser window had texture the depth is kept, with the worst cost: the filter refuses it as an anchor,
    yet it tells where the surface runs.
    """
    u, v = pixel_grid(view.camera)
    inverse = view.planes[..., 0] * u + view.planes[..., 1] * v + view.planes[..., 2]
    known = view.known & (inverse > 0)
    return np.where(known, 1 / np.where(known, inverse, 1), 0).astype(np.float32)


def _quads(gray: np.ndarray) -> np.ndarray:
    """Per pixel the grey values of itself, its right, lower and lower right neighbour, in one uint32 [H, W].

    A bilinear sample then costs one gather instead of four.
    """
    padded = np.pad(gray, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    upper, lower = padded[:-1], padded[1:]
    return upper[:, :-1] | upper[:, 1:] << 8 | lower[:, :-1] << 16 | lower[:, 1:] << 24


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _picture(gray: np.ndarray) -> _Picture:
    return _Picture(gray.shape[1], gray.shape[0], gray.ctypes.data)


def _intrinsics(camera: Camera) -> ctypes.Array:
    K = index_intrinsics(camera)
    return (ctypes.c_float * 4)(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def _source(reference: _View, source: _View, depth: np.ndarray | None) -> _Source:
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

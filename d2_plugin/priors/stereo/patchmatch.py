"""PatchMatch multi-view stereo on the GPU or the CPU, compiled at first use: the same planes on both.

Each pixel carries a plane, linear in inverse depth over the image, and keeps the best of what it draws at random and
of what its neighbours found (`kernels/spread.h`). Resolution doubles from level to level, and planes are carried
over exactly. After each level but the last, where it takes as long as all else and finds hardly more, views hand their
planes to one another, as in PatchMatch Stereo (Bleyer and others, 2011). In the end each plane has fitted the noise of
its own window; averaging those that agree takes that out.
Coordinates are array indices, as in `d2_plugin.priors.geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import view_pair
from d2_plugin.priors.stereo import patchmatch_cuda
from d2_plugin.priors.stereo.patchmatch_kernel import PatchMatchKernel
from d2_plugin.priors.stereo.pyramid import NO_MATCH, LevelView, at_resolution, levels, plane_depth
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.priors.stereo.source_views import choose_sources
from d2_plugin.recordings.recording import Camera

ROUNDS = (4, 2, 2, 1)
"""Red-black sweeps at each resolution, coarsest first; each resolution is twice the one before, the last is full. A
second sweep at full resolution fits noise."""
OFFERED, BETTER = 0.5, 0.8
"""Planes of a lower cost are handed to other views, which take them below this share of what their own cost."""


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
        settings: `patchmatch_device`, `patchmatch_sources`, `min_angle`, `max_angle` and `seed` are used.
        wanted: bool [H, W] per camera, pixels to match; all where None. Others may have no depth.

    Returns:
        Per camera: planar depth float32 [H, W] (0 where nothing matches) and 1 - NCC float32 [H, W] in 0..2. A view
        that no other one meets at an angle has no depth anywhere.

    Raises:
        NoCompiler: there is neither a GPU nor a C++ compiler.
    """
    settings = settings or StereoSettings()
    sources = [choose_sources(index, cameras, depth_range, settings) for index in range(len(cameras))]
    kernel = _kernel(settings)(sources, depth_range, settings)
    masks: Sequence[np.ndarray | None] = [None] * len(cameras) if wanted is None else wanted
    views: list[LevelView] = []
    for level, (divisor, rounds) in enumerate(levels(cameras, ROUNDS)):
        coarser: Sequence[LevelView | None] = views or [None] * len(cameras)
        views = [at_resolution(*view, divisor) for view in zip(grays, cameras, coarser, masks)]
        for index, (view, coarse) in enumerate(zip(views, coarser)):
            same = coarse is not None and coarse.gray.shape == view.gray.shape  # too small for the level before
            # At full size random planes are hardly ever better than those handed down.
            kernel.match(views, index, level, 1 if same else rounds, not same and (divisor > 1 or level == 0))
        if divisor > 1:
            _exchange(kernel, views, sources, len(ROUNDS) + level)
    for view in views:
        kernel.average(view)
    return [(plane_depth(view), view.cost) for view in views]


def _exchange(kernel: PatchMatchKernel, views: Sequence[LevelView], sources: list[list[int]], stage: int) -> None:
    """Let each view try the planes of its sources, all as they are now, and keep what matches better."""
    trials = [
        replace(
            view, planes=handed_over(view, [views[other] for other in chosen]), cost=np.full_like(view.cost, NO_MATCH)
        )
        for view, chosen in zip(views, sources)
    ]
    for index, (view, trial) in enumerate(zip(views, trials)):
        kernel.match(trials, index, stage, rounds=1, explore=False)
        better = trial.cost < BETTER * view.cost
        view.planes[better], view.cost[better] = trial.planes[better], trial.cost[better]


def handed_over(view: LevelView, sources: Sequence[LevelView]) -> np.ndarray:
    """The planes [H, W, 3] of a view, and in their place those of its sources that land there, the best of them last.

    With p' ~ (A + k pi^T) p on a plane pi^T p = 1 / z, the same plane of the other view is A^-T pi / (1 + k^T A^-T pi).
    """
    planes, found = view.planes.copy(), [np.empty((0, 6))]
    for source in sources:
        pair, (v, u) = view_pair(source.camera, view.camera), np.nonzero(source.cost < OFFERED)
        theirs = source.planes[v, u].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):  # what is endless, or seen edge on, lands nowhere
            x, y, z = pair.project(u, v, 1 / (theirs[:, 0] * u + theirs[:, 1] * v + theirs[:, 2]))
            ours = theirs @ np.linalg.inv(pair.A)
            ours /= 1 + (ours @ pair.k)[:, None]
            x, y = np.rint(x), np.rint(y)
            there = np.abs((ours[:, 0] * x + ours[:, 1] * y + ours[:, 2]) * z - 1) < 0.5
        there &= (z > 0) & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
        found.append(np.column_stack([source.cost[v, u], y, x, ours])[there])
    handed = np.concatenate(found)
    handed = handed[np.argsort(-handed[:, 0], kind="stable")]
    row, column = handed[:, 1:3].T.astype(int)
    planes[row, column] = handed[:, 3:]
    return planes


def _kernel(settings: StereoSettings) -> type[PatchMatchKernel]:
    """Where planes spread: on the GPU where there is one, unless the settings say otherwise."""
    if settings.patchmatch_device == "cpu":
        return PatchMatchKernel
    why_not = patchmatch_cuda.why_not_usable()
    if why_not is None:
        return patchmatch_cuda.CudaPatchMatchKernel
    if settings.patchmatch_device == "cuda":
        raise D2Error(f"patchmatch_device = 'cuda', but {why_not}: set it to 'auto' or 'cpu'")
    return PatchMatchKernel

"""The kernels on the GPU: `kernels/gpu.cu`, what they need in memory, and in which order they run.

The same functions as in `native`, on float32 tensors of one device; `ops` registers them for CUDA. How a kernel gets to
run is a `Launcher`'s business: `cuda_runtime` has NVRTC compile and the driver launch them; the tests have a
launcher that runs the very same kernels on the CPU.

Everything is enqueued on torch's current stream. `rasterize` and `survey` wait for the device once, to learn how many
pairs of Gaussian and tile there are to allocate (so they cannot be captured in a CUDA graph); `backward` never waits.
No float is added atomically: the same inputs give the same bits in every run on the same kind of device.
"""

from __future__ import annotations

import functools
import warnings

import torch
from torch import Tensor

from d2_plugin.compiler.nvrtc import NoCuda
from d2_plugin.errors import D2Error
from d2_plugin.protocol import Survey
from d2_plugin.rasterizer.cuda_frame import GATHERERS, MOMENTS, STATISTICS, THREADS, TILE, WARP, Frame, Launcher
from d2_plugin.rasterizer.cuda_runtime import CudaLauncher
from d2_plugin.rasterizer.frame import RECORD

MOST_PAIRS = 2**31 - 1
"""Slots are 32-bit integers."""


@functools.cache
def launcher(device: torch.device) -> Launcher:
    """The launcher of a CUDA device; `device` has an index.

    Raises:
        d2_plugin.compiler.nvrtc.NoCuda: no driver, no NVRTC, or an architecture that it does not know.
    """
    return CudaLauncher(device)


@functools.cache
def available(device: torch.device) -> bool:
    """Whether the kernels are available on a CUDA device; warns once where they are not."""
    try:
        launcher(device)
    except NoCuda as error:
        warnings.warn(
            f"{error}. Until then splatting on {device} runs in plain torch: the same images and gradients, but orders "
            "of magnitude slower and with much more memory.",
            stacklevel=3,
        )
        return False
    return True


def rasterize(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    near_edge: Tensor | None,
    width: int,
    height: int,
    constants: list[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """color [H, W, C], depth_sum, alpha and front [H, W], and the state that `backward` needs (records, lists).

    front is empty, [0], without `near_edge` [H, W].
    """
    frame = _frame(means, covariances, opacities, T_camera_world, K, width, height, constants)
    frame.channels = colors.shape[1]
    frame.point(colors=colors, background=background, screen_offsets=screen_offsets)
    runs = launcher(means.device)
    records, lists = _bin(runs, frame, means, K)
    color = means.new_empty(height, width, colors.shape[1])
    depth_sum, alpha = means.new_empty(height, width), means.new_empty(height, width)
    front = means.new_empty((0,) if near_edge is None else (height, width))
    frame.point(color=color, depth_sum=depth_sum, alpha=alpha, near_edge=near_edge, front=front)
    runs.launch("d2_render" if near_edge is None else "d2_render_front", frame.tiles, frame)
    return color, depth_sum, alpha, front, records, lists


def backward(
    grad_color: Tensor | None,
    grad_depth_sum: Tensor | None,
    grad_alpha: Tensor | None,
    grad_front: Tensor | None,
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor | None,
    screen_offsets: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    near_edge: Tensor | None,
    constants: list[float],
    color: Tensor,
    depth_sum: Tensor,
    alpha: Tensor,
    front: Tensor,
    records: Tensor,
    lists: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means, covariances, opacities, colors, background [C] and screen_offsets [M, 2]."""
    height, width, channels = color.shape
    frame = _frame(means, covariances, opacities, T_camera_world, K, width, height, constants)
    frame.channels = channels
    frame.point(colors=colors, background=background, screen_offsets=screen_offsets, records=records)
    frame.point(color=color, depth_sum=depth_sum, alpha=alpha, near_edge=near_edge, front=front)
    frame.point(grad_color=grad_color, grad_depth_sum=grad_depth_sum, grad_alpha=grad_alpha, grad_front=grad_front)
    frame.pairs = (len(lists) - 2 * len(means) - frame.tiles - 1) // 2
    _point_lists(frame, lists)
    grad_means, grad_covariances = torch.empty_like(means), torch.empty_like(covariances)
    grad_opacities, grad_colors = torch.empty_like(opacities), torch.empty_like(colors)
    grad_screen_offsets = means.new_empty(len(means), 2)
    frame.point(grad_means=grad_means, grad_covariances=grad_covariances, grad_opacities=grad_opacities)
    frame.point(grad_colors=grad_colors, grad_screen_offsets=grad_screen_offsets)
    # Zeros, since tiles whose pixels are all finished leave the rest of their pairs alone.
    frame.point(values=means.new_zeros(frame.pairs, MOMENTS + channels), moments=means.new_empty(len(means), MOMENTS))
    runs = launcher(means.device)
    with_front = near_edge is not None and grad_front is not None
    runs.launch("d2_backward_front" if with_front else "d2_backward", frame.tiles, frame)
    if (more := channels - (WARP - MOMENTS)) > 0:
        runs.launch("d2_backward_colors", frame.tiles, frame, rows=-(-more // WARP))
    runs.launch("d2_gather", _blocks(len(means) * GATHERERS), frame)
    runs.launch("d2_project_backward", _blocks(len(means)), frame)
    grad_background = means.new_zeros(channels)
    if grad_color is not None:
        grad_background = ((1 - alpha)[..., None] * grad_color).sum((0, 1))
    return grad_means, grad_covariances, grad_opacities, grad_colors, grad_background, grad_screen_offsets


def survey(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    prior_depth: Tensor,
    reliability: Tensor,
    near_edge: Tensor | None,
    T_camera_world: Tensor,
    K: Tensor,
    constants: list[float],
    eps: float,
) -> Survey:
    """See `d2_plugin.rasterizer.survey`; `prior_depth`, `reliability` and `near_edge` are [H, W] float32."""
    height, width = prior_depth.shape
    frame = _frame(means, covariances, opacities, T_camera_world, K, width, height, constants)
    frame.eps = eps
    frame.point(prior_depth=prior_depth, reliability=reliability, near_edge=near_edge)
    runs = launcher(means.device)
    _bin(runs, frame, means, K)
    weight, error, max_weight, front = (torch.empty_like(opacities) for _ in range(4))
    hits = torch.empty_like(opacities, dtype=torch.int32)
    depth_sum, alpha = torch.empty_like(prior_depth), torch.empty_like(prior_depth)
    statistics = STATISTICS if near_edge is None else STATISTICS + 1
    frame.point(depth_sum=depth_sum, alpha=alpha, values=means.new_zeros(frame.pairs, statistics))
    frame.point(weight=weight, error=error, max_weight=max_weight, front_weight=front, hits=hits)
    runs.launch("d2_survey" if near_edge is None else "d2_survey_front", frame.tiles, frame)
    runs.launch("d2_gather_survey", _blocks(len(means) * GATHERERS), frame)
    return Survey(weight, error, max_weight, hits, depth_sum, alpha, front)


def _frame(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    T_camera_world: Tensor,
    K: Tensor,
    width: int,
    height: int,
    constants: list[float],
) -> Frame:
    frame = Frame(width=width, height=height, tiles_x=-(-width // TILE), count=len(means))
    frame.constants[:] = constants
    camera = (part.to(means, non_blocking=True).contiguous() for part in (T_camera_world, K))
    frame.point(**dict(zip(("T_camera_world", "K"), camera)))
    return frame.point(means=means, covariances=covariances, opacities=opacities)


def _bin(runs: Launcher, frame: Frame, means: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Records [M, 16] and the lists: per tile, the Gaussians that may reach it, front to back (ties by index).

    Two stable sorts, Gaussians by depth and then pairs by tile, move less memory than one of long keys over all pairs.
    """
    records = means.new_empty(len(means), RECORD)
    tile_counts = means.new_empty(len(means), dtype=torch.int32)
    depths = torch.empty_like(means[:, 0])
    frame.point(records=records, tile_counts=tile_counts, depths=depths)
    runs.launch("d2_project", _blocks(len(means)), frame)
    by_depth = torch.sort(depths, stable=True).indices
    ends = torch.cumsum(tile_counts[by_depth], 0, dtype=torch.int64)
    frame.pairs = _count_pairs(ends, K)
    lists = means.new_empty(2 * frame.pairs + 2 * len(means) + frame.tiles + 1, dtype=torch.int32)
    parts = _point_lists(frame, lists)
    parts["by_depth"].copy_(by_depth)
    parts["slot_ends"].copy_(ends)
    slot_tiles, slot_ids = (torch.empty_like(parts["ids"]) for _ in range(2))
    frame.point(slot_tiles=slot_tiles, slot_ids=slot_ids)
    runs.launch("d2_list", _blocks(len(means)), frame)
    keys = slot_tiles.to(torch.int16) if frame.tiles < 2**15 else slot_tiles  # half the passes of a radix sort
    keys, slots = torch.sort(keys, stable=True)
    parts["slots"].copy_(slots)
    parts["ids"].copy_(slot_ids[slots])
    tiles = torch.arange(frame.tiles + 1, dtype=keys.dtype, device=keys.device)
    parts["tile_starts"].copy_(torch.searchsorted(keys, tiles, out_int32=True))
    return records, lists


def _count_pairs(ends: Tensor, K: Tensor) -> int:
    """Number of pairs; the only wait for the device, on which the check of the camera rides along."""
    last = ends[-1] if len(ends) else ends.new_zeros(())
    pairs, skewed = torch.stack([last, (K[0, 1] != 0).to(last)]).tolist()
    if skewed:
        skew = K[0, 1].item()
        raise D2Error(f"K has skew {skew}, expected 0: undistort the images to a pinhole camera without skew")
    if pairs > MOST_PAIRS:
        raise D2Error(f"{pairs} pairs of Gaussian and tile, at most 2^31 - 1 are possible: use a smaller image")
    return pairs


def _point_lists(frame: Frame, lists: Tensor) -> dict[str, Tensor]:
    """Views into one buffer: ids [P], slots [P], by_depth [M], slot_ends [M], tile_starts [tiles + 1]."""
    sizes = [frame.pairs, frame.pairs, frame.count, frame.count, frame.tiles + 1]
    parts = dict(zip(("ids", "slots", "by_depth", "slot_ends", "tile_starts"), torch.split(lists, sizes)))
    frame.point(**parts)
    return parts


def _blocks(threads: int) -> int:
    return -(-threads // THREADS)

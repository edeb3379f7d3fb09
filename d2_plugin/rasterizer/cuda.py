"""The kernels on the GPU: `kernels/gpu.cu`, compiled by NVRTC, launched by the driver, in the order in which they run.

The same functions as in `native`, on float32 tensors of one device. How a kernel runs is up to a `Launcher`; the tests
have one that runs the very same kernels on the CPU.

Everything is enqueued on torch's current stream. `rasterize` and `survey` wait for the device once, to learn how many
pairs of Gaussian and tile there are to allocate (so they cannot be captured in a CUDA graph); `backward` never waits.
No float is added atomically: the same inputs give the same bits in every run on the same kind of device.
"""

from __future__ import annotations

import ctypes
import functools
import warnings

import torch
from torch import Tensor

from d2_plugin.compiler.driver import Driver
from d2_plugin.compiler.kernels import fields
from d2_plugin.compiler.nvrtc import Binary, NoCuda, Program, build
from d2_plugin.errors import D2Error
from d2_plugin.rasterizer.native import KERNELS, RECORD, SLOWER, Pinhole, PointingFrame
from d2_plugin.rasterizer.reference import refuse_skew

PROGRAM = Program(KERNELS / "gpu.cu", (KERNELS / "splat.h",))

FLAGS = ("--std=c++17", "--fmad=false")
"""No contraction: the forward and the backward pass must decide alike which fragments count; splat.h asks for fma."""

CACHED_CHANNELS = 3
"""Number of colors of the kernels that also run the survey, which needs no colors."""

MOST_PAIRS = 2**31 - 1
"""Slots are 32-bit integers."""

THREADS, TILE, GATHERERS, WARP, MOMENTS, STATISTICS = 256, 16, 8, 32, 7, 4
"""As in gpu.cu: threads of a block, pixels along a side of a tile, and the sizes of what is gathered."""


class Frame(PointingFrame):
    """d2::Frame of kernels/gpu.cu: everything that one call works on."""

    _fields_ = fields(
        "float constants[7]",
        "int width height channels tiles_x",
        "float eps",
        "long count pairs",
        "pointer T_camera_world K means covariances opacities colors screen_offsets background",
        "pointer prior_depth reliability near_edge records tile_counts depths by_depth slot_ends",
        "pointer slot_tiles slot_ids ids slots tile_starts color depth_sum alpha front",
        "pointer grad_color grad_depth_sum grad_alpha grad_front values moments",
        "pointer grad_means grad_covariances grad_opacities grad_colors grad_screen_offsets",
        "pointer weight error max_weight front_weight hits",
    )

    @property
    def tiles(self) -> int:
        """Number of tiles of the image."""
        return self.tiles_x * -(-self.height // TILE)


def flags_for(channels: int) -> tuple[str, ...]:
    """What NVRTC is told to compile the kernels for so many colors."""
    return (*FLAGS, f"-DD2_CHANNELS={channels}", f"-DD2_FRAME_SIZE={ctypes.sizeof(Frame)}")


def binary_for(capability: int, channels: int) -> Binary:
    """The kernels for GPUs of compute capability `capability` (90 is sm_90) and `channels` colors, from the cache
    where they are there already.

    Raises:
        NoCuda: no NVRTC, or it does not know the GPU.
        CompileError: NVRTC refused the source.
    """
    return build("rasterizer", PROGRAM, flags_for(channels), capability)


class Launcher:
    """Launches the kernels of gpu.cu on one CUDA device, on torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        """Compile (or find) the kernels for `device`, with the errors of `Driver`."""
        self._driver = Driver(device, lambda *variant: binary_for(*variant), CACHED_CHANNELS)

    def launch(self, kernel: str, blocks: int, frame: Frame, rows: int = 1) -> None:
        """Enqueue `kernel` on a grid of `blocks` x `rows` blocks of THREADS threads; `frame` is copied.

        The kernels are those compiled for `frame.channels` colors (any where it is 0).
        """
        self._driver.launch(kernel, frame.channels or CACHED_CHANNELS, (blocks, rows), THREADS, frame)


launcher = functools.cache(Launcher)
"""The one `Launcher` of a CUDA device with an index."""


@functools.cache
def available(device: torch.device) -> bool:
    """Whether the kernels are available on a CUDA device; warns once where they are not."""
    try:
        launcher(device)
    except NoCuda as error:
        warnings.warn(f"{error}. Until then splatting on {device} {SLOWER}", stacklevel=3)
        return False
    return True


def frame_of(
    means: Tensor, covariances: Tensor, opacities: Tensor, camera: Pinhole, constants: list[float], channels: int
) -> Frame:
    """What every call works on; its tensors are kept as long as the frame."""
    *matrices, width, height = camera
    frame = Frame(width=width, height=height, channels=channels, tiles_x=-(-width // TILE), count=len(means))
    frame.constants[:] = constants
    there = (part.to(means, non_blocking=True).contiguous() for part in matrices)
    frame.pointing(**dict(zip(("T_camera_world", "K"), there)))
    return frame.pointing(means=means, covariances=covariances, opacities=opacities)


def project(frame: Frame, means: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Records [M, 16] and the lists: per tile, the Gaussians that may reach it, front to back (ties by index).

    Two stable sorts, Gaussians by depth and then pairs by tile, move less memory than one of long keys over all pairs.
    """
    runs = launcher(means.device)
    records = means.new_empty(len(means), RECORD)
    tile_counts = means.new_empty(len(means), dtype=torch.int32)
    depths = torch.empty_like(means[:, 0])
    frame.pointing(records=records, tile_counts=tile_counts, depths=depths)
    runs.launch("d2_project", _blocks(len(means)), frame)
    by_depth = torch.sort(depths, stable=True).indices
    ends = torch.cumsum(tile_counts[by_depth], 0, dtype=torch.int64)
    frame.pairs = _count_pairs(ends, K)
    lists = means.new_empty(2 * frame.pairs + 2 * len(means) + frame.tiles + 1, dtype=torch.int32)
    parts = point_lists(frame, lists)
    parts["by_depth"].copy_(by_depth)
    parts["slot_ends"].copy_(ends)
    slot_tiles, slot_ids = (torch.empty_like(parts["ids"]) for _ in range(2))
    frame.pointing(slot_tiles=slot_tiles, slot_ids=slot_ids)
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
        refuse_skew(K[0, 1].item())
    if pairs > MOST_PAIRS:
        raise D2Error(f"{pairs} pairs of Gaussian and tile, at most 2^31 - 1 are possible: use a smaller image")
    return pairs


def point_lists(frame: Frame, lists: Tensor) -> dict[str, Tensor]:
    """Views into one buffer: ids [P], slots [P], by_depth [M], slot_ends [M], tile_starts [tiles + 1]."""
    frame.pairs = (len(lists) - 2 * frame.count - frame.tiles - 1) // 2
    sizes = [frame.pairs, frame.pairs, frame.count, frame.count, frame.tiles + 1]
    parts = dict(zip(("ids", "slots", "by_depth", "slot_ends", "tile_starts"), torch.split(lists, sizes)))
    frame.pointing(**parts)
    return parts


def render(frame: Frame, device: torch.device) -> None:
    """Fill color, depth_sum, alpha and, with a near edge, front."""
    launcher(device).launch("d2_render_front" if frame.near_edge else "d2_render", frame.tiles, frame)


def backward(frame: Frame, device: torch.device) -> None:
    """Fill the gradients, but for the background's."""
    runs, channels = launcher(device), frame.channels
    # Zeros, since tiles whose pixels are all finished leave the rest of their pairs alone.
    values = torch.zeros(frame.pairs, MOMENTS + channels, device=device)
    frame.pointing(values=values, moments=torch.empty(frame.count, MOMENTS, device=device))
    with_front = frame.near_edge and frame.grad_front
    runs.launch("d2_backward_front" if with_front else "d2_backward", frame.tiles, frame)
    if (more := channels - (WARP - MOMENTS)) > 0:
        runs.launch("d2_backward_colors", frame.tiles, frame, rows=-(-more // WARP))
    runs.launch("d2_gather", _blocks(frame.count * GATHERERS), frame)
    runs.launch("d2_project_backward", _blocks(frame.count), frame)


def gather(frame: Frame, device: torch.device) -> None:
    """Fill the statistics of the survey."""
    runs = launcher(device)
    statistics = STATISTICS + 1 if frame.near_edge else STATISTICS
    frame.pointing(values=torch.zeros(frame.pairs, statistics, device=device))
    runs.launch("d2_survey_front" if frame.near_edge else "d2_survey", frame.tiles, frame)
    runs.launch("d2_gather_survey", _blocks(frame.count * GATHERERS), frame)


def _blocks(threads: int) -> int:
    return -(-threads // THREADS)

"""What the host and the kernels of `kernels/gpu.cu` share: its files, its constants, its Frame, and who launches it."""

from __future__ import annotations

import ctypes
from typing import Protocol

from d2_plugin.rasterizer.frame import KERNELS, PointingFrame

SOURCE, HEADERS = KERNELS / "gpu.cu", (KERNELS / "splat.h",)

THREADS = 256
"""Of a block; THREADS of gpu.cu."""
TILE = 16
"""Side of a tile in pixels; TILE of gpu.cu."""
GATHERERS, WARP, MOMENTS, STATISTICS = 8, 32, 7, 4
"""As in gpu.cu."""

_float, _int, _long, _pointer = ctypes.c_float, ctypes.c_int32, ctypes.c_int64, ctypes.c_void_p


class Frame(PointingFrame):
    """d2::Frame of kernels/gpu.cu: everything that one call works on; absent pointers stay null."""

    _fields_ = (
        ("constants", _float * 7),
        *((name, _int) for name in ("width", "height", "channels", "tiles_x")),
        ("eps", _float),
        *((name, _long) for name in ("count", "pairs")),
        *(
            (name, _pointer)
            for name in (
                *("T_camera_world", "K"),
                *("means", "covariances", "opacities", "colors", "screen_offsets", "background"),
                *("prior_depth", "reliability", "near_edge"),
                *("records", "tile_counts", "depths", "by_depth", "slot_ends"),
                *("slot_tiles", "slot_ids", "ids", "slots", "tile_starts"),
                *("color", "depth_sum", "alpha", "front"),
                *("grad_color", "grad_depth_sum", "grad_alpha", "grad_front"),
                *("values", "moments"),
                *("grad_means", "grad_covariances", "grad_opacities", "grad_colors", "grad_screen_offsets"),
                *("weight", "error", "max_weight", "front_weight", "hits"),
            )
        ),
    )

    @property
    def tiles(self) -> int:
        """Number of tiles of the image."""
        return self.tiles_x * -(-self.height // TILE)


class Launcher(Protocol):
    """Runs kernels of gpu.cu on one device."""

    def launch(self, kernel: str, blocks: int, frame: Frame, rows: int = 1) -> None:
        """Enqueue `kernel` on a grid of `blocks` x `rows` blocks of THREADS threads; `frame` is copied.

        The kernels are those compiled for `frame.channels` colors (any where it is 0).
        """

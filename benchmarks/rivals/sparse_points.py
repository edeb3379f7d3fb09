"""Depth of the sparse points, as gsplat's `--depth_loss` uses it (after DS-NeRF).

gsplat, examples/simple_trainer.py: with D the expected depth of the render, bilinear between pixels, and z_i the depths
of the points that an image sees, at p_i,

    L = lambda S mean_i | 1 / D(p_i) - 1 / z_i |,    1 / D = 0 where D = 0,    lambda = 0.01

S is the scale of the scene; here half the median depth of the points, which this project's backbones call extent.
gsplat knows from COLMAP which image sees a point. Here no track is kept: a point counts in each image that it
projects into, unless stereo sees a surface more than 5 % in front of it. Of several instants, the nearest one's points
count.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.rivals.inputs import Inputs, RivalLoss, expected_depth
from d2_plugin.hooks import Context, HookConfig
from d2_plugin.hooks.depth_loss import depth_and_alpha
from d2_plugin.priors.geometry import projected
from d2_plugin.protocol import View
from d2_plugin.runs.start import scene_extent
from d2_plugin.settings import NotNegative, Share


@dataclass(frozen=True)
class SparsePointsConfig(HookConfig):
    """Depth of sparse points (gsplat)."""

    weight: NotNegative = 0.01
    """lambda, as published."""
    hidden: Share = 0.05
    """A point this share of its depth behind the stereo surface is hidden."""


class Seen(NamedTuple):
    """The sparse points that one image sees."""

    pixels: Tensor  # [M, 2] column and row, pixel i has its centre at i + 0.5
    depths: Tensor  # [M] planar z


def sparse_point_loss(depth: Tensor, seen: Seen, scale: float) -> Tensor:
    """S mean |1 / D(p_i) - 1 / z_i|, a scalar; 0 with zero gradients without a point.

    Args:
        depth: expected depth [H, W], 0 where there is none.
        scale: S, world units.
    """
    if not len(seen.depths):
        return 0.0 * depth.sum()
    found = at_pixels(depth, seen.pixels)
    positive = found > 0
    inverse = torch.where(positive, 1 / torch.where(positive, found, 1), 0)
    return scale * (inverse - 1 / seen.depths).abs().mean()


def at_pixels(values: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values [M] of a map [H, W] at pixels [M, 2], the nearest at the rim."""
    size = pixels.new_tensor([values.shape[1], values.shape[0]])
    grid = (2 * pixels / size - 1)[None, None]
    return F.grid_sample(values[None, None], grid, align_corners=False, padding_mode="border")[0, 0, 0]


class SparsePointDepth(RivalLoss):
    """Adds the loss of the views of the present step."""

    config: SparsePointsConfig

    def __init__(self, config: SparsePointsConfig, inputs: Inputs) -> None:
        super().__init__(config, inputs)
        self._seen: dict[tuple[str, int], Seen] = {}
        scene, positions = inputs.scene, inputs.points.positions
        self.scale = scene_extent(scene.recording, scene.train_cameras, positions).radius

    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view, None where it sees no point."""
        seen = self.seen(view)
        if not len(seen.depths):
            return None
        return sparse_point_loss(expected_depth(*depth_and_alpha(context, view), 0)[0], seen, self.scale)

    def seen(self, view: View) -> Seen:
        """The points that a view sees."""
        key = (view.camera, view.frame)
        if key not in self._seen:
            camera = self.inputs.scene.recording.cameras[view.camera]
            pixels, depths, inside = projected(camera, self._of_this_instant(view))
            pixels, depths = pixels[inside], depths[inside]
            shown = ~self._hidden(view, pixels, depths)
            self._seen[key] = Seen(*(torch.from_numpy(part[shown]).to(view.K) for part in (pixels, depths)))
        return self._seen[key]

    def _of_this_instant(self, view: View) -> np.ndarray:
        """Positions [M, 3] of the instant nearest in time."""
        times, positions = self.inputs.points.times, self.inputs.points.positions
        if not len(times):
            return positions
        away = np.abs(times - view.time)
        return positions[away <= away.min() + 1e-9]

    def _hidden(self, view: View, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Whether stereo sees a surface in front, bool [M]; no where there is no stereo."""
        stereo = self.inputs.stereo_depth(view.camera, view.frame)
        if stereo is None:
            return np.zeros(len(depths), bool)
        columns, rows = pixels.astype(int).T
        surface = stereo[rows, columns]
        return (surface > 0) & (depths > surface * (1 + self.config.hidden))

"""What rivals read of a depth prior: the same monocular maps and the same stereo that D² was built from."""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from d2_plugin.hooks import Context, Hook, HookConfig
from d2_plugin.priors.geometric_source import stored_depth
from d2_plugin.priors.monocular.network import upsample
from d2_plugin.protocol import View
from d2_plugin.rasterizer import Splats, rasterize
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.start import TimedPoints
from d2_plugin.store.files import EntryFolder
from d2_plugin.store.store import PriorStore

KEPT_MAPS = 512
"""Monocular maps kept in memory; the others are read again."""


@dataclass(eq=False)
class Inputs:
    """The scene of a run, its triangulated points, and the folder of the full depth prior."""

    scene: Scene
    points: TimedPoints
    priors: Path
    _maps: dict[tuple[str, int], Tensor | None] = field(default_factory=dict)

    def inverse_depth(self, view: View) -> Tensor | None:
        """The monocular map [H, W] as predicted, not aligned: larger is nearer, up to scale and shift.

        A metric map is inverted. None where the view has no map. What is not finite is NaN.
        """
        key = (view.camera, view.frame)
        if key not in self._maps:
            if len(self._maps) >= KEPT_MAPS:
                self._maps.clear()
            self._maps[key] = self._read(view)
        return self._maps[key]

    @cached_property
    def _store(self) -> PriorStore:
        return PriorStore.open(self.priors)

    def _read(self, view: View) -> Tensor | None:
        entry = EntryFolder(self.priors / "cache" / "mono").find(view.camera, view.frame)
        found = self.scene.recording.mono(view.camera, view.frame) if entry is None else entry.array()
        if found is None:
            return None
        values = torch.from_numpy(upsample(np.asarray(found), view.height, view.width)).to(view.K.device)
        if self._kind(view) == "metric":
            values = torch.where(values > 0, 1 / values, torch.nan)
        return torch.where(values.isfinite(), values, torch.nan)

    def _kind(self, view: View) -> str:
        """What the maps are: a network's declared kind stands in the record of the prior."""
        record = self._store.record(view.camera, view.frame) or {}
        return record.get("settings", {}).get("mono_kind") or self.scene.recording.mono_kind or "relative"

    def stereo_depth(self, camera: str, frame: int) -> np.ndarray | None:
        """Filtered geometric depth D^g, float32 [H, W], 0 where there is none; None where stereo was left out."""
        entry = EntryFolder(self.priors / "cache" / "stereo").find(camera, frame)
        return None if entry is None else stored_depth(entry).depth


def expected_depth(depth_sum: Tensor, alpha: Tensor, least: float = 0.5) -> tuple[Tensor, Tensor]:
    """(sum of w z over sum of w, bool where alpha exceeds `least`), both [H, W]; 0 without gradient elsewhere."""
    valid = alpha > least
    return torch.where(valid, depth_sum / torch.where(valid, alpha, 1), 0), valid


def in_unit_range(values: Tensor, mask: Tensor) -> Tensor:
    """The map brought to 0..1 over the pixels that count; a constant one to 0."""
    if not mask.any():
        return values
    low, high = values[mask].min(), values[mask].max()
    return (values - low) / torch.where(high > low, high - low, 1)


def rendered_again(context: Context, view: View, splats: Splats) -> Tensor:
    """Differentiable sum of w z [H, W] of other splats than the trainer's."""
    colors = splats.means.new_zeros(len(splats.means), 1)
    return rasterize(splats, colors, view, context.backbone.settings).depth_sum


class RivalLoss(Hook):
    """A rival that adds a loss: the weighted mean of its `term` over the views of the present step that have one."""

    def __init__(self, config: HookConfig, inputs: Inputs) -> None:
        super().__init__(config)
        self.inputs = inputs

    def loss(self, context: Context) -> Tensor | None:
        """A scalar, None where no view has a term."""
        terms = [term for view in context.views if (term := self.term(context, view)) is not None]
        return self.weight(context.step) * torch.stack(terms).mean() if terms else None

    @abstractmethod
    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view, unweighted; None where it has no depth to compare with."""

    def weight(self, step: int) -> float:
        """Of the loss at this step."""
        return self.config.weight

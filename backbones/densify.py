"""The backbones' own adaptive density control, as 3D Gaussian Splatting does it, on Gaussians with and without time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Protocol

import torch
from torch import Tensor

from d2_plugin.settings import Count, Every, Range, Settings, Share

from .gaussians import Gaussians

DENSE = 0.01
"""Gaussians larger than this share of the extent are split, smaller ones cloned."""
FAINT = 0.005
"""Gaussians below this opacity are pruned."""
HUGE = 0.5
"""Gaussians larger than this share of the extent are pruned."""
SHRINK = math.log(1.6)
"""What the log-scales of the two children of a split Gaussian are smaller by."""


class Growable(Protocol):
    """What density control needs of a model; `statistics` of its Gaussians hold `screen_gradient` and `seen`."""

    gaussians: Gaussians
    extent: float

    def __len__(self) -> int: ...
    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor: ...
    def append(self, rows: Mapping[str, Tensor]) -> None: ...
    def select(self, index: Tensor) -> None: ...


@dataclass(frozen=True)
class DensifySettings(Settings):
    """When the backbone clones, splits and prunes, as 3D Gaussian Splatting does; opacities are never reset."""

    enabled: bool = True
    """Whether the backbone changes the number of its Gaussians at all."""
    start: Share = 0.05
    """Share of the run before the first edit."""
    stop: Share = 0.6
    """Share of the run after which there are no more edits."""
    every: Every = 100
    """Steps between edits."""
    gradient: Annotated[float, Range(0, 1e6)] = 5e-4
    """Mean screen-space gradient (in units of half the image) above which a Gaussian is cloned or split. The official
    2e-4 is for many views: at 3e-4 four of *plaza* have half as many Gaussians again and no better images."""
    budget: Count = 100_000
    """No growth beyond this number of Gaussians."""


@torch.no_grad()
def densify(model: Growable, settings: DensifySettings, step: int, iterations: int, generator: torch.Generator) -> None:
    """Clone, split and prune as scheduled; all structure changes go through model.append and model.select."""
    begun = settings.enabled and settings.start * iterations <= step <= settings.stop * iterations
    if not begun or step % settings.every:
        return
    grow(model, settings, generator)
    prune(model)
    for value in model.gaussians.statistics.values():
        value.zero_()


def grow(model: Growable, settings: DensifySettings, generator: torch.Generator) -> None:
    """Clone small Gaussians with a large mean screen-space gradient, split large ones in two."""
    statistics = model.gaussians.statistics
    mean_gradient = statistics["screen_gradient"] / statistics["seen"].clamp(min=1)
    wanted = torch.nonzero(mean_gradient > settings.gradient).squeeze(-1)
    room = max(settings.budget - len(model), 0)
    if len(wanted) > room:
        wanted = wanted[mean_gradient[wanted].topk(room).indices.sort().values]
    large = model.gaussians["log_scales"][wanted].exp().amax(-1) > DENSE * model.extent
    cloned, split = wanted[~large], wanted[large]
    raw = {name: value.detach() for name, value in model.gaussians.parameters.items()}
    rows = {name: torch.cat([value[cloned], value[split], value[split]]) for name, value in raw.items()}
    children = slice(len(cloned), None)
    _scatter_children(model, rows, children, generator)
    if len(rows["positions"]):
        model.append(rows)
        keep = torch.ones(len(model), dtype=torch.bool, device=split.device)
        keep[split] = False
        model.select(torch.nonzero(keep).squeeze(-1))


def prune(model: Growable, faint: float = FAINT) -> None:
    """Remove Gaussians that are nearly transparent or as large as the scene."""
    raw = model.gaussians
    opaque = torch.sigmoid(raw["opacity_logits"]) >= faint
    keep = opaque & (raw["log_scales"].exp().amax(-1) <= HUGE * model.extent)
    if not keep.all():
        model.select(torch.nonzero(keep).squeeze(-1))


def _scatter_children(model: Growable, rows: dict[str, Tensor], children: slice, generator: torch.Generator) -> None:
    """Move split children to samples of their parent Gaussian (in 4D where there is time) and shrink them."""
    parents = {name: value[children] for name, value in rows.items()}
    rotations = model.rotations(parents)
    temporal = len(rotations) == 4
    scales = parents["log_scales"].exp()
    if temporal:
        scales = torch.cat([scales, parents["log_time_scales"].exp()[:, None]], -1)
    noise = torch.randn(scales.shape, generator=generator, dtype=scales.dtype).to(scales.device)
    offset = (rotations * (scales * noise).T).sum(1).T
    rows["positions"][children] += offset[:, :3]
    rows["log_scales"][children] -= SHRINK
    if temporal:
        rows["times"][children] += offset[:, 3]
        rows["log_time_scales"][children] -= SHRINK

"""The backbones' own adaptive density control, as 3D Gaussian Splatting does it, on Gaussians with and without time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from d2_plugin.settings import Count, Every, NotNegative, Positive, Settings, Share, Steps

from .gaussians import Gaussians
from .relocate import relocate, wander


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
    """When the backbone clones, splits, prunes and resets."""

    enabled: bool = True
    """Whether the backbone changes the number of its Gaussians at all."""
    method: Literal["split", "relocate"] = "split"
    """What an edit does: "split" clones and splits where the screen-space gradient is large and prunes (3DGS),
    "relocate" moves the Gaussians that pruning would remove to opaque ones and grows by a share (3DGS-MCMC).
    "relocate" with growth 0.1 against "split", four views, 500 steps, one seed: studio -.68 dB with D2 and -.26
    without, plaza -1.50 and -.56."""
    start: Share = 0.05
    """Share of the run before the first edit."""
    stop: Share = 0.6
    """Share of the run after which there are no more edits."""
    every: Every = 100
    """Steps between edits."""
    gradient: NotNegative = 1e-3
    """Mean screen-space gradient (in units of half the image) above which a Gaussian is cloned or split.
    Studio, four views, backbone alone, 2000 steps, seeds 0 1 2, held-out PSNR: 25.4, 24.9, 26.1 dB at 1e-3 (4,300
    Gaussians); 26.4, 24.3, 23.9 dB at 5e-4 (10,700). The official 2e-4 only overfits where there are few views."""
    dense_fraction: Positive = 0.01
    """Gaussians larger than this fraction of the extent are split, smaller ones cloned."""
    opacity: Share = 0.005
    """Gaussians below this opacity are pruned."""
    scale_fraction: Positive = 0.5
    """Gaussians larger than this fraction of the extent are pruned."""
    reset_every: Steps = 0
    """Steps between opacity resets to 0.01; 0 never resets.
    Official: every 3000 of 30000 steps. In runs of some thousand steps a reset costs 1 dB on studio."""
    budget: Count = 100_000
    """No growth beyond this number of Gaussians."""
    growth: NotNegative = 0.05
    """By what share an edit of method "relocate" increases their number."""
    wander: NotNegative = 0.1
    """Noise of method "relocate" on the positions of nearly transparent Gaussians, in their standard deviations a
    step; it falls to none at the last step."""


@torch.no_grad()
def densify(model: Growable, settings: DensifySettings, step: int, iterations: int, generator: torch.Generator) -> None:
    """Clone, split, prune and reset as scheduled; all structure changes go through model.append and model.select."""
    if not settings.enabled or not settings.start * iterations <= step <= settings.stop * iterations:
        return
    if settings.method == "relocate":
        wander(model, settings.wander * (1 - step / max(iterations, 1)), generator)
    if step % settings.every == 0:
        if settings.method == "relocate":
            room = min(int(settings.growth * len(model)), max(settings.budget - len(model), 0))
            relocate(model, ~kept(model, settings), room, generator)
        else:
            grow(model, settings, generator)
            prune(model, settings)
        for value in model.gaussians.statistics.values():
            value.zero_()
    if settings.reset_every and step % settings.reset_every == 0:
        logits = model.gaussians["opacity_logits"]
        model.gaussians.overwrite("opacity_logits", logits.clamp(max=torch.logit(torch.tensor(0.01)).item()))


def grow(model: Growable, settings: DensifySettings, generator: torch.Generator) -> None:
    """Clone small Gaussians with a large mean screen-space gradient, split large ones in two."""
    statistics = model.gaussians.statistics
    mean_gradient = statistics["screen_gradient"] / statistics["seen"].clamp(min=1)
    wanted = torch.nonzero(mean_gradient > settings.gradient).squeeze(-1)
    room = max(settings.budget - len(model), 0)
    if len(wanted) > room:
        wanted = wanted[mean_gradient[wanted].topk(room).indices.sort().values]
    large = model.gaussians["log_scales"][wanted].exp().amax(-1) > settings.dense_fraction * model.extent
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


def prune(model: Growable, settings: DensifySettings) -> None:
    """Remove Gaussians that are nearly transparent or as large as the scene."""
    keep = kept(model, settings)
    if not keep.all():
        model.select(torch.nonzero(keep).squeeze(-1))


def kept(model: Growable, settings: DensifySettings) -> Tensor:
    """Which Gaussians [N] are neither nearly transparent nor as large as the scene."""
    raw = model.gaussians
    opaque = torch.sigmoid(raw["opacity_logits"]) >= settings.opacity
    bounded = raw["log_scales"].exp().amax(-1) <= settings.scale_fraction * model.extent
    return opaque & bounded


def _scatter_children(model: Growable, rows: dict[str, Tensor], children: slice, generator: torch.Generator) -> None:
    """Move split children to samples of their parent Gaussian (in 4D where there is time) and shrink them by 1.6."""
    parents = {name: value[children] for name, value in rows.items()}
    temporal = "times" in rows
    scales = parents["log_scales"].exp()
    if temporal:
        scales = torch.cat([scales, parents["log_time_scales"].exp()[:, None]], -1)
    noise = torch.randn(scales.shape, generator=generator, dtype=scales.dtype).to(scales.device)
    offset = (model.rotations(parents) * (scales * noise).T).sum(1).T
    rows["positions"][children] += offset[:, :3]
    rows["log_scales"][children] -= torch.log(torch.tensor(1.6))
    if temporal:
        rows["times"][children] += offset[:, 3]
        rows["log_time_scales"][children] -= torch.log(torch.tensor(1.6))

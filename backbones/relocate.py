"""Relocation instead of clone and split: Gaussians that are nearly gone start again where opaque ones are.

After "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024): a copy joins its source in such a
way that the image stays nearly what it was, so that no edit costs quality, and faint Gaussians wander.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from .gaussians import Gaussians

MOST_COPIES = 51
"""Of one Gaussian at a time, itself included: the alternating sum over binomials loses all its digits far beyond."""

FAINT, SHARPNESS = 0.005, 100.0
"""Opacity at which half of the noise is left, and how fast it falls from there: x0 and k of the official code."""


class Movable(Protocol):
    """What relocation needs of a model."""

    gaussians: Gaussians

    def __len__(self) -> int: ...
    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor: ...
    def append(self, rows: Mapping[str, Tensor]) -> None: ...
    def select(self, index: Tensor) -> None: ...


def relocate(model: Movable, dead: Tensor, room: int, generator: torch.Generator) -> None:
    """Move the Gaussians `dead` [N] to others, drawn by opacity, and add `room` more there.

    To whoever follows the rows a moved Gaussian is a removed one and a new one.
    """
    opacities = torch.sigmoid(model.gaussians["opacity_logits"].detach())
    chances = torch.where(dead, 0.0, opacities.nan_to_num(0.0)).cpu()
    wanted = int(dead.sum()) + room
    if not wanted or not chances.any():
        return
    drawn = torch.multinomial(chances, wanted, replacement=True, generator=generator).to(opacities.device)
    copies = torch.bincount(drawn, minlength=len(model))
    sources = torch.nonzero(copies).squeeze(-1)
    _share(model.gaussians, sources, 1 + copies[sources].clamp(max=MOST_COPIES - 1))
    model.append({name: value.detach()[drawn] for name, value in model.gaussians.parameters.items()})
    if dead.any():
        keep = torch.cat([~dead, dead.new_ones(wanted)])
        model.select(torch.nonzero(keep).squeeze(-1))


def _share(gaussians: Gaussians, sources: Tensor, counts: Tensor) -> None:
    """Give each of `sources` the opacity and the size that it and its copies have together what it had alone."""
    opacity, factor = shared_opacity_and_scale(torch.sigmoid(gaussians["opacity_logits"].detach()[sources]), counts)
    gaussians.revise("opacity_logits", sources, torch.logit(opacity, eps=1e-6))
    gaussians.revise("log_scales", sources, gaussians["log_scales"].detach()[sources] + factor.log()[:, None])


def shared_opacity_and_scale(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of n equal Gaussians that stand for one of opacity o [K], and the factor of its scale.

    Equation 9 of the paper: o' = 1 - (1 - o)^(1/n), and by the hockey-stick identity of its double sum
    factor = o / sum_{k=1..n} binom(n, k) (-1)^(k-1) o'^k / sqrt(k), in float64 since the sum alternates.
    """
    old, n = opacities.double(), counts.double()
    new = -torch.expm1(torch.log1p(-old.clamp(max=1 - 1e-6)) / n)
    k = torch.arange(1, MOST_COPIES + 1, dtype=torch.float64, device=old.device)
    binomial = torch.lgamma(n + 1)[:, None] - torch.lgamma(k + 1) - torch.lgamma((n[:, None] - k + 1).clamp(min=1))
    terms = torch.exp(binomial + k * new[:, None].log()) * (-1.0) ** (k - 1) / k.sqrt()
    total = torch.where(k <= n[:, None], terms, 0).sum(1)
    return new.to(opacities), (old / total).to(opacities)


def wander(model: Movable, strength: float, generator: torch.Generator) -> None:
    """Move faint Gaussians at random by `strength` of their standard deviations: they look for something to show.

    The paper moves by the covariance times a length, which depends on the scene's unit; this does not.
    """
    opacities = torch.sigmoid(model.gaussians["opacity_logits"].detach())
    gate = torch.sigmoid(SHARPNESS * (FAINT - opacities))
    faint = torch.nonzero(gate > 1e-4).squeeze(-1)
    if not strength or not len(faint):
        return
    rows = {name: value.detach()[faint] for name, value in model.gaussians.parameters.items()}
    noise = torch.randn(len(faint), 3, generator=generator).to(gate) * rows["log_scales"].exp() * gate[faint, None]
    turn = model.rotations(rows)[:3, :3]  # of a Gaussian with time: its axes in space
    model.gaussians.revise("positions", faint, rows["positions"] + strength * (turn * noise.T).sum(1).T, keep=True)

"""A scene of any model as one cubic curve for each Gaussian, for formats that have nothing else."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from d2_plugin.gaussians.moving import LinearMotion, MovingGaussians
from d2_plugin.viewing.export.keys import ALPHA_MIN, Offset, covariances_of, distance, state_at
from d2_plugin.viewing.export.scene import ExportScene

FOREVER = 1e4
"""Temporal standard deviation, in clips, of Gaussians that never fade: F differs from 1 by less than 1e-8."""
INSTANTS = 24
"""At most so many frames, spread over the clip, are fitted."""


class Curves(NamedTuple):
    """x(u) = position + velocity T u + bends[:, 0] u^2 + bends[:, 1] u^3 with u = t / T - 1/2."""

    gaussians: MovingGaussians
    bends: Tensor  # [N, 2, 3]
    offset: Offset


def fit_curves(scene: ExportScene) -> Curves:
    """Least squares over the frames; shape and opacity are the means over the frames in which a Gaussian is drawn."""
    count, seconds = len(scene.harmonics.coefficients), scene.clip.seconds
    times = seconds[:: -(-len(seconds) // INSTANTS)]
    span = scene.clip.duration or 1.0
    states, before = [], None
    for time in times:
        before = state_at(scene.splats_at, count, time, before)
        states.append(before)
    opacities = torch.stack([state.opacities for state in states])
    kept = (opacities.amax(0) >= ALPHA_MIN).nonzero()[:, 0]
    states = [state.select(kept) for state in states]
    powers = torch.tensor([[(time / span - 0.5) ** k for k in range(4)] for time in times]).double()[:, : len(times)]
    paths = torch.stack([state.positions for state in states])
    fitted = torch.linalg.lstsq(powers, paths.flatten(1)).solution.unflatten(1, (len(kept), 3))
    fitted = torch.cat([fitted, fitted.new_zeros(4 - len(fitted), len(kept), 3)])
    weights = opacities[:, kept] / opacities[:, kept].sum(0)
    factors = sum(weight[:, None] * state.factors for weight, state in zip(weights, states))
    off = torch.zeros(len(kept)).double()
    for row, state in zip(powers, states):
        told = torch.einsum("k,knc->nc", row, fitted[: len(row)])
        pixels = distance(torch.cat([told, factors], 1), torch.cat(state[:2], 1)) * scene.pixels_per_unit(told)
        off = torch.maximum(off, torch.where(state.opacities >= ALPHA_MIN, pixels, 0))
    middle = torch.full((len(kept),), span / 2).double()
    motion = LinearMotion(fitted[1] / span, middle, torch.full_like(middle, FOREVER * span))
    harmonics = scene.harmonics._replace(coefficients=scene.harmonics.coefficients[kept])
    shown = MovingGaussians(fitted[0], covariances_of(factors), opacities[:, kept].mean(0), harmonics, motion)
    return Curves(shown, fitted[2:].transpose(0, 1).contiguous(), Offset.of(off))

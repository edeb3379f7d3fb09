"""How far off a file is: what a reader finds in it against what went in."""

from __future__ import annotations

from collections.abc import Callable

import torch

from d2_plugin.gaussians.moving import MovingGaussians
from d2_plugin.viewing.export.keys import ALPHA_MIN, Offset, State, distance, state_at
from d2_plugin.viewing.export.scene import ExportScene

INSTANTS = 5
"""Over the clip, at which both are compared."""


def rounding(scene: ExportScene, true_at: Callable[[float], State], read_at: Callable[[float], State]) -> Offset:
    """Pixels of the nearest training camera, largest over the clip, of the Gaussians that are drawn."""
    duration, worst = scene.clip.duration, torch.zeros(0).double()
    for time in sorted({duration * i / (INSTANTS - 1) for i in range(INSTANTS)}):
        true, read = true_at(time), read_at(time)
        off = distance(torch.cat(true[:2], 1), torch.cat(read[:2], 1)) * scene.pixels_per_unit(true.positions)
        off = torch.where(true.opacities >= ALPHA_MIN, off, 0)
        worst = torch.maximum(worst, off) if len(worst) else off
    return Offset.of(worst)


def states_of(gaussians: MovingGaussians) -> Callable[[float], State]:
    """Moving Gaussians as states by time; one that is not drawn has opacity 0."""
    return lambda time: state_at(gaussians.at, len(gaussians), time)

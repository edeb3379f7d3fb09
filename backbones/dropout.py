"""Leaving Gaussians out at random, so that those behind them learn as well and none rests on another.

After DropGaussian (Park, Ryu, Kim, CVPR 2025): in a training render each Gaussian is left out with a chance that
grows with the step, and the others are more opaque by as much.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


class Dropout:
    """The chance r of the present step, and the random numbers."""

    def __init__(self, most: float, seed: int = 0) -> None:
        self.most, self.rate = most, 0.0
        self._generator = torch.Generator().manual_seed(seed)

    def thinned(self, opacities: Tensor) -> Tensor:
        """Opacities [M] of a training render: 0 with chance r, else o / (1 - r), at most 1."""
        if not self.rate:
            return opacities
        kept = (torch.rand(len(opacities), generator=self._generator) >= self.rate).to(opacities)
        return (opacities * kept / (1 - self.rate)).clamp(max=1.0)

    def advance(self, step: int, iterations: int) -> None:
        """The chance for the step after `step`: it grows from 0 to `most` over the run."""
        self.rate = self.most * min(step / max(iterations, 1), 1.0)

    def state_dict(self) -> dict[str, Any]:
        """What an exact continuation needs."""
        return {"rate": self.rate, "generator": self._generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self.rate = state["rate"]
        self._generator.set_state(state["generator"].cpu())

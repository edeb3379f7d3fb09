"""Stopping early: patches of the training images that no loss sees say when more steps only fit the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from d2_plugin.gaussians.photometric import as_numbers
from d2_plugin.settings import AtLeastOne, Range, Settings

PATCHES = 16
"""Patches along the longer side of an image."""


@dataclass(frozen=True)
class EarlyStopSettings(Settings):
    """When a run ends before its last step."""

    share: Annotated[float, Range(0, 1, open_high=True)] = 0.0
    """Share of each training image that is held out of the photometric loss, in patches of a sixteenth of its longer
    side; 0 holds nothing out and never stops early."""
    patience: AtLeastOne = 5
    """Rounds through all training images without a smaller error in those patches after which training ends."""


class EarlyStop:
    """The patches of one run and their errors, round by round."""

    def __init__(self, settings: EarlyStopSettings, seed: int) -> None:
        self.settings, self.seed = settings, seed
        self.rounds: list[float] = []
        """Mean squared error of the patches over each round through all images."""
        self._errors: list[float] = []

    @property
    def stopped(self) -> bool:
        """Whether the smallest error is `patience` rounds old."""
        if not self.rounds:
            return False
        best = min(range(len(self.rounds)), key=self.rounds.__getitem__)
        return len(self.rounds) - 1 - best >= self.settings.patience

    def target(self, index: int, image: Tensor, rendered: Tensor) -> Tensor:
        """The image [H, W, 3] that the loss compares with: in its patches what was rendered, so nothing is learnt.

        `image` is in 0..1, or as bytes.
        """
        if not self.settings.share:
            return image
        image = as_numbers(image)
        mask = self.mask(index, *image.shape[:2]).to(image.device)
        rendered = rendered.detach()
        self._errors.append((rendered - image)[mask].square().mean().item() if mask.any() else 0.0)
        return torch.where(mask[..., None], rendered, image)

    def mask(self, index: int, height: int, width: int) -> Tensor:
        """The held-out pixels [H, W] of an image, the same each time."""
        side = -(-max(height, width) // PATCHES)
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + index)
        chosen = torch.rand(-(-height // side), -(-width // side), generator=generator) < self.settings.share
        return chosen.repeat_interleave(side, 0).repeat_interleave(side, 1)[:height, :width]

    def end_round(self) -> None:
        """All images were seen once more."""
        if self._errors:
            self.rounds.append(sum(self._errors) / len(self._errors))
            self._errors = []

    def state_dict(self) -> dict[str, Any]:
        """The errors so far."""
        return {"rounds": list(self.rounds), "errors": list(self._errors)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self.rounds, self._errors = list(state["rounds"]), list(state["errors"])

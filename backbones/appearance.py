"""Cameras of different exposure: an affine change of colour for each training camera, learnt with the Gaussians.

The Gaussians keep the colours of the mean camera, which is what a camera that did not train is shown in: the changes
of all cameras have the mean zero, so that no common change can hide in them. Where gains were measured beforehand the
changes begin there, and a camera that does not train is shown with its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

RATE = 5e-3
"""Learning rate of the changes: a gain that is 20 % off takes about fifty steps of its camera."""


class Appearance:
    """Per training camera c a matrix M_c [3, 4]: it sees (I + M_c - mean M) (r, g, b, 1) instead of (r, g, b)."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.changes: dict[str, nn.Parameter] = {}
        self._optimizers: dict[str, torch.optim.Adam] = {}
        self.measured: dict[str, Tensor] = {}
        """Changes [3, 4] of cameras that do not train, relative to the mean of those that do."""

    def start_from(self, gains: Mapping[str, Sequence[float]], training: Sequence[str]) -> None:
        """Begin with measured gains, by camera and channel, before the first step; only their ratios count."""
        if not set(training) <= gains.keys():
            return
        ratios = {name: torch.tensor(gain, dtype=torch.float64, device=self.device) for name, gain in gains.items()}
        mean = torch.stack([ratios[name] for name in training]).mean(0)
        for name, ratio in ratios.items():
            change = torch.cat([torch.diag(ratio / mean - 1), ratio.new_zeros(3, 1)], 1).float()
            if name not in training:
                self.measured[name] = change
            elif name not in self.changes:
                self._add(name, change)

    def change(self, camera: str) -> Tensor | None:
        """M_c - mean M [3, 4]; None where `camera` never trained.

        A camera that is asked for with gradients trains from then on. The gradient is that of M_c alone, as the others
        do not see its images.
        """
        if camera in self.measured:
            return self.measured[camera]
        if camera not in self.changes:
            if not torch.is_grad_enabled():
                return None
            self._add(camera, torch.zeros(3, 4, device=self.device))
        mean = torch.stack([value.detach() for value in self.changes.values()]).mean(0)
        return self.changes[camera] - mean

    def optimize(self, share: float = 1.0) -> None:
        """One optimizer step of the cameras that have a gradient at this share of the rate, gradients cleared."""
        for camera, value in self.changes.items():
            if value.grad is not None:
                self._optimizers[camera].param_groups[0]["lr"] = share * RATE
                self._optimizers[camera].step()
                self._optimizers[camera].zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Changes and optimizers, by camera; those of cameras that do not train are measured and have none."""
        fixed = {camera: {"measured": value.clone()} for camera, value in self.measured.items()}
        return fixed | {
            camera: {"change": value.detach().clone(), "optimizer": deepcopy(self._optimizers[camera].state_dict())}
            for camera, value in self.changes.items()
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`: with its cameras, and no others."""
        self.changes, self._optimizers, self.measured = {}, {}, {}
        for camera, part in state.items():
            if "measured" in part:
                self.measured[camera] = part["measured"].to(self.device).clone()
                continue
            self._add(camera, part["change"].to(self.device).clone())
            self._optimizers[camera].load_state_dict(deepcopy(part["optimizer"]))

    def _add(self, camera: str, change: Tensor) -> None:
        self.changes[camera] = nn.Parameter(change)
        self._optimizers[camera] = torch.optim.Adam([self.changes[camera]], lr=RATE, eps=1e-15)


def changed(colors: Tensor, change: Tensor | None) -> Tensor:
    """Colours [..., 3] after a change [3, 4]. What Gaussians and background show is linear in their colours, so
    theirs are changed: there are fewer of them than of pixels."""
    return colors if change is None else colors + functional.linear(colors, change[:, :3], change[:, 3])

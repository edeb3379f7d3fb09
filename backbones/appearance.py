"""Cameras of different exposure: an affine change of colour for each training camera, learnt with the Gaussians.

The Gaussians keep the colours of the mean camera, which is what a camera that did not train is shown in: the changes
of all cameras have the mean zero, so that no common change can hide in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from d2_plugin.rasterizer import Render

RATE = 5e-3
"""Learning rate of the changes: a gain that is 20 % off takes about fifty steps of its camera."""


class Appearance:
    """Per training camera c a matrix M_c [3, 4]: it sees (I + M_c - mean M) (r, g, b, 1) instead of (r, g, b)."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.changes: dict[str, nn.Parameter] = {}
        self._optimizers: dict[str, torch.optim.Adam] = {}

    def seen_by(self, camera: str, render: Render) -> Render:
        """The render in the colours of `camera`; unchanged where that camera never trained.

        A camera that renders with gradients trains from then on.
        """
        if torch.is_grad_enabled() and camera not in self.changes:
            self._add(camera, torch.zeros(3, 4, device=self.device))
        if camera not in self.changes:
            return render
        change = self.change(camera)
        return render._replace(color=render.color + render.color @ change[:, :3].T + change[:, 3])

    def change(self, camera: str) -> Tensor:
        """M_c - mean M [3, 4]; the gradient is that of M_c alone, since the other cameras do not see this picture."""
        mean = torch.stack([value.detach() for value in self.changes.values()]).mean(0)
        return self.changes[camera] - mean

    def optimize(self) -> None:
        """One optimizer step of the cameras that have a gradient, gradients cleared."""
        for camera, value in self.changes.items():
            if value.grad is not None:
                self._optimizers[camera].step()
                self._optimizers[camera].zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Changes and optimizers, by camera."""
        return {
            camera: {"change": value.detach().clone(), "optimizer": self._optimizers[camera].state_dict()}
            for camera, value in self.changes.items()
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`: with its cameras, and no others."""
        self.changes, self._optimizers = {}, {}
        for camera, part in state.items():
            self._add(camera, part["change"].to(self.device).clone())
            self._optimizers[camera].load_state_dict(part["optimizer"])

    def _add(self, camera: str, change: Tensor) -> None:
        self.changes[camera] = nn.Parameter(change)
        self._optimizers[camera] = torch.optim.Adam([self.changes[camera]], lr=RATE, eps=1e-15)

"""Cameras whose clocks are a little off: a shift in time for each training camera, learnt with the Gaussians.

What import leaves open (a fraction of a frame, where motion alone said when the cameras started) shows as a ghost of
whatever moves. The shift of a camera is the time that passed, in its images, since the instant that they are named
after. The median of all shifts is zero, so that they cannot wander off together, and a camera that does not train is
shown at the instant that was asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn

from d2_plugin.rasterizer import View
from d2_plugin.settings import NotNegative, Positive, Settings, Share


@dataclass(frozen=True)
class ClockSettings(Settings):
    """A shift in time that each training camera learns."""

    learn: bool = False
    """Whether it is learnt. Off is right where cameras are triggered together, and where their offsets are known."""
    rate: Positive = 0.05
    """Learning rate in frames. One of four cameras a frame late, half-size images, one seed: studio finds .7 of it
    in 900 steps at 0.05, .10 in 300 steps at 0.02; plaza, wider and with smaller movers, finds none of it."""
    last_rate: NotNegative = 0.1
    """Learning rate at the last step, as a share of `rate`; exponential in between."""
    begin: Share = 0.1
    """Share of the run before which nothing is learnt: what moves must be there first."""
    most: Positive = 3.0
    """Frames that a shift may reach: beyond, import has found the wrong offset."""


class Clocks:
    """Per training camera its shift, in the unit of `View.time`; its optimizer; and the time from frame to frame."""

    def __init__(self, settings: ClockSettings) -> None:
        self.settings = settings
        self.frame = 1.0
        """Time from one frame of a camera to the next."""
        self.shifts: dict[str, nn.Parameter] = {}
        self._optimizers: dict[str, torch.optim.Adam] = {}
        self.learning = settings.begin <= 0

    def look_at(self, views: Sequence[View]) -> None:
        """The training cameras and their frame rate, before the first step."""
        times: dict[str, list[float]] = {}
        for view in views:
            times.setdefault(view.camera, []).append(view.time)
        steps = [b - a for taken in map(sorted, times.values()) for a, b in zip(taken, taken[1:])]  # noqa: RUF007
        self.frame = median(steps) if steps else 1.0
        for camera in times:
            self._add(camera, 0.0)

    def in_frames(self) -> dict[str, float]:
        """Shift of each training camera, in frames."""
        middle = self._middle()
        return {camera: value.item() - middle for camera, value in self.shifts.items()}

    def time_of(self, view: View) -> float:
        """The instant at which its camera took the view."""
        shift = self.shifts.get(view.camera)
        return view.time if shift is None else view.time + (shift.item() - self._middle()) * self.frame

    def feel(self, camera: str, gradient: Tensor) -> None:
        """Take the loss's derivative with respect to the time of a view that `camera` took."""
        if camera in self.shifts:
            self.shifts[camera].grad = (gradient.detach() * self.frame).to(self.shifts[camera])

    def optimize(self, step: int, iterations: int) -> None:
        """One optimizer step of the camera that has a gradient, gradients cleared; the rate for the next step set."""
        s, done = self.settings, min(step / max(iterations, 1), 1.0)
        for camera, value in self.shifts.items():
            if value.grad is not None and self.learning:
                self._optimizers[camera].param_groups[0]["lr"] = s.rate * s.last_rate**done if s.last_rate else s.rate
                self._optimizers[camera].step()
                value.data.clamp_(-s.most, s.most)
            value.grad = None
        self.learning = step >= s.begin * iterations

    def state_dict(self) -> dict[str, Any]:
        """Shifts and optimizers: enough for a bitwise continuation."""
        cameras = {
            camera: {"shift": value.item(), "optimizer": self._optimizers[camera].state_dict()}
            for camera, value in self.shifts.items()
        }
        return {"cameras": cameras, "frame": self.frame, "learning": self.learning}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self.shifts, self._optimizers = {}, {}
        self.frame, self.learning = state["frame"], state["learning"]
        for camera, part in state["cameras"].items():
            self._add(camera, part["shift"])
            self._optimizers[camera].load_state_dict(part["optimizer"])

    def _middle(self) -> float:
        return median(value.item() for value in self.shifts.values()) if self.shifts else 0.0

    def _add(self, camera: str, frames: float) -> None:
        self.shifts[camera] = nn.Parameter(torch.tensor(frames, dtype=torch.float64))  # on the CPU: one number
        self._optimizers[camera] = torch.optim.Adam([self.shifts[camera]], lr=self.settings.rate)

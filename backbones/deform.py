"""Canonical Gaussians and a deformation field: one set of 3D Gaussians, moved, turned and scaled at each instant.

The field is in the style of 4DGaussians; where the scene has one instant or no motion it is left out (`temporal=False`)
and these are ordinary 3D Gaussians.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import MovingGaussians, moving_gaussians
from d2_plugin.gaussians.native_slice import STATIC
from d2_plugin.gaussians.rotation4d import identities, rotation_matrices_3d, temporal_marginal, unit_quaternions
from d2_plugin.gaussians.slicing import LOG_SCALE_LIMIT, MARGINAL_CUT, rows_to_draw, slice_gaussians
from d2_plugin.protocol import Points
from d2_plugin.rasterizer import Splats, View
from d2_plugin.settings import Seed

from .deform_fields import Box, HexPlaneField, HexPlaneSettings, Offsets
from .model import SplatModel, SplatSettings, decayed, settled
from .starting import isotropic_rows, lasting_rows
from .trainer import Trainer, TrainSettings

__all__ = ["Deform", "DeformSettings", "TrainSettings", "Trainer", "create", "settings_from"]


TIME_NOISE = 5e-3
"""Standard deviation of the noise on a training step's time at the first step, as a share of the duration; it falls to
zero at half of the run. Official: a tenth of the frame interval, in real scenes."""
LASTING = 10.0
"""Temporal standard deviation of a Gaussian at the start, in durations: it exists at all instants."""
FIELD_DECAY = 0.1
"""Learning rates of the field at the last step, as a share of the first; exponential in between."""


@dataclass(frozen=True)
class DeformSettings(SplatSettings):
    """Model and optimizers of the backbone."""

    seed: Seed = 0
    """Seed of the field's start and of the noise on time; the global random state is never used."""
    hexplane: HexPlaneSettings = dataclasses.field(default_factory=HexPlaneSettings)
    """The planes of the field."""


class Deform(SplatModel):
    """N canonical Gaussians, their field, and an optimizer for each.

    Parameters (raw) beside those of `SplatModel`: rotations [N, 4], and with time: times [N], log_time_scales [N]. As
    in SpacetimeGaussians (Li et al. 2024) a Gaussian fades away from its instant, o F(t); it starts to exist at all
    times, unless it is inserted with a lifetime.
    """

    settings: DeformSettings
    settings_kind = DeformSettings

    def __init__(self, rows: Mapping[str, Tensor], settings: DeformSettings, extent: float, duration: float) -> None:
        super().__init__(rows, settings, extent, duration)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self.field: HexPlaneField | None = None
        self._noise = 0.0
        if settings.temporal:
            box = Box.around(rows["positions"], extent)
            self.field = HexPlaneField(box, settings.hexplane, self._generator).to(rows["positions"])
            self.field_optimizer = torch.optim.Adam(self.field.parameter_groups(), eps=1e-15, fused=True)

    @staticmethod
    def initial_rows(points: Points, settings: DeformSettings, duration: float) -> dict[str, Tensor]:
        """See `SplatModel.initial_rows`; without lifetimes they are always there, and the field says where."""
        rows = isotropic_rows(points, settings.sh_degree)
        rows["rotations"] = identities(len(points.positions), points.positions)
        if settings.temporal:
            rows |= lasting_rows(points, LASTING * max(duration, 1e-12))
        return rows

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable; a time outside the scene shows its first or last instant.

        With gradients enabled the time is that of the present training step, noise included.

        Raises:
            D2Error: the time is not a number.
        """
        if self.field is not None and math.isnan(view.time):
            raise D2Error(f"the time of camera '{view.camera}', frame {view.frame} is NaN: give every view a time")
        raw, lives = self._canonical(), None
        if self.field is not None:
            rows, lives = self._living(min(max(view.time, 0.0), self.duration))
            raw = {name: value.index_select(0, rows) for name, value in raw.items()}
        noise = self._noise if torch.is_grad_enabled() else 0.0
        offsets = self.offsets(raw["positions"], view.time + noise)
        if offsets is not None:
            raw["positions"] = raw["positions"] + offsets.positions
            raw["log_scales"] = raw["log_scales"] + offsets.log_scales
            raw["left"] = raw["left"] + offsets.rotations
        splats = slice_gaussians(raw)
        return splats if lives is None else splats._replace(opacities=splats.opacities * lives, rows=rows)

    def _living(self, time: float) -> tuple[Tensor, Tensor]:
        """Rows [M] of the Gaussians that exist at a time, for which alone the field is evaluated, and F(t) [M]."""
        variances = (2 * self.gaussians["log_time_scales"].clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)).exp()
        offset = time - self.gaussians["times"]
        alive = temporal_marginal(offset, variances).detach() > MARGINAL_CUT
        rows = rows_to_draw(alive)
        marginal = temporal_marginal(torch.where(alive, offset, 0.0), variances) * alive  # no gradient is 0 * inf
        return rows, marginal.index_select(0, rows)

    def _canonical(self) -> dict[str, Tensor]:
        g = self.gaussians
        return {name: g["rotations" if name == "left" else name] for name in STATIC}

    def moving(self) -> MovingGaussians | None:
        """See `SplatModel.moving`: only without time."""
        return moving_gaussians(self._canonical(), self.harmonics()) if self.field is None else None

    def offsets(self, positions: Tensor, time: float) -> Offsets | None:
        """What the field adds at canonical `positions` [K, 3]; None where nothing is deformed: without time."""
        if self.field is None or not len(positions):
            return None
        return self.field(positions, time / self.duration)

    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Rotation matrices [3, 3, K] of raw rows."""
        return rotation_matrices_3d(unit_quaternions(rows["rotations"]))

    def regularization(self) -> Tensor | float:
        """What keeps the field smooth."""
        return self.field.regularization() if self.field is not None else 0.0

    def optimize(self, step: int, iterations: int) -> None:
        """One step of both optimizers, gradients cleared; learning rates and noise for the next step set."""
        super().optimize(step, iterations)
        if self.field is None:
            return
        self.field_optimizer.step()
        self.field_optimizer.zero_grad(set_to_none=True)
        for group, start in zip(self.field_optimizer.param_groups, self.field.parameter_groups()):
            group["lr"] = start["lr"] * decayed(FIELD_DECAY, step, iterations) * settled(step, iterations)
        strength = max(1 - 2 * step / max(iterations, 1), 0.0) * TIME_NOISE * self.duration
        self._noise = strength * torch.randn((), generator=self._generator).item()

    def state_dict(self) -> dict[str, Any]:
        """Gaussians and field with their optimizers, and the noise: enough for a bitwise continuation."""
        state: dict[str, Any] = {"gaussians": super().state_dict()}
        if self.field is not None:
            state |= {
                "field": {name: value.clone() for name, value in self.field.state_dict().items()},
                "field_optimizer": deepcopy(self.field_optimizer.state_dict()),
                "generator": self._generator.get_state(),
                "noise": self._noise,
            }
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        super().load_state_dict(state["gaussians"])
        if self.field is not None:
            self.field.load_state_dict({"unit": self.field.unit} | state["field"])  # versions before saved no unit
            self.field_optimizer.load_state_dict(deepcopy(state["field_optimizer"]))
            self._generator.set_state(state["generator"].cpu())
            self._noise = state["noise"]


create, settings_from = Deform.create, Deform.settings_from

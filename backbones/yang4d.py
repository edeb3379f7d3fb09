"""Native 4D Gaussians after Yang et al. (ICLR 2024): one 4D Gaussian in (x, y, z, t), sliced at the rendered instant.

Mathematics as in fudan-zvg/4d-gaussian-splatting; where the scene has one instant or no motion the temporal
dimension is left out (`temporal=False`) and these are ordinary 3D Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians, moving_gaussians
from d2_plugin.gaussians.native_slice import STATIC, TEMPORAL
from d2_plugin.gaussians.rotation4d import identities, rotation_matrices_3d, rotation_matrices_4d, unit_quaternions
from d2_plugin.gaussians.slicing import slice_gaussians
from d2_plugin.protocol import Points
from d2_plugin.rasterizer import Splats, View
from d2_plugin.settings import Range

from .model import SplatModel, SplatSettings
from .starting import isotropic_rows, lasting_rows
from .trainer import Trainer, TrainSettings

__all__ = ["TrainSettings", "Trainer", "Yang4D", "Yang4DSettings", "create", "settings_from"]


@dataclass(frozen=True)
class Yang4DSettings(SplatSettings):
    """Model and optimizer of the backbone."""

    sh_time_degree: Annotated[int, Range(0, 8)] = 0
    """Number of cosines in time that modulate the colour; 0: constant in time."""


class Yang4D(SplatModel):
    """N 4D Gaussians with their optimizer.

    Parameters (raw) beside those of `SplatModel`: left [N, 4], and where asked for: times [N], log_time_scales [N],
    right [N, 4].
    """

    settings: Yang4DSettings
    settings_kind = Yang4DSettings

    @staticmethod
    def initial_rows(points: Points, settings: Yang4DSettings, duration: float) -> dict[str, Tensor]:
        """See `SplatModel.initial_rows`.

        Rotations start at the identity and the temporal standard deviation at sqrt(duration / 5), as in the official
        code (a variance of a fifth of the duration, gaussian_model.py:280), or at the point's lifetime where that is
        shorter.
        """
        rows = isotropic_rows(points, settings.sh_degree, _time_degree(settings))
        rows["left"] = identities(len(points.positions), points.positions)
        if settings.temporal:
            rows |= lasting_rows(points, math.sqrt(max(duration, 1e-12) / 5))
            rows["right"] = rows["left"].clone()
        return rows

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable.

        Raises:
            D2Error: the time is not a number; one outside the scene is fine, and shows less or nothing.
        """
        if self.settings.temporal and math.isnan(view.time):
            raise D2Error(f"the time of camera '{view.camera}', frame {view.frame} is NaN: give every view a time")
        return slice_gaussians(self._raw(), view.time)

    def _raw(self) -> dict[str, Tensor]:
        return {name: self.gaussians[name] for name in (TEMPORAL if self.settings.temporal else STATIC)}

    def rotations(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Rotation matrices of raw rows, [4, 4, K] or without time [3, 3, K]."""
        left = unit_quaternions(rows["left"])
        if "times" not in rows:
            return rotation_matrices_3d(left)
        return rotation_matrices_4d(left, unit_quaternions(rows["right"]))

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as seen in `view`, at its time."""
        degree = _time_degree(self.settings)
        phase = (view.time - self.gaussians["times"][splats.rows]) / self.duration if degree else None
        return self.harmonic_colors(view, splats, phase, degree)

    def harmonics(self) -> Harmonics:
        """See `SplatModel.harmonics`; with the cosines in time."""
        return super().harmonics()._replace(time_degree=_time_degree(self.settings))

    def moving(self) -> MovingGaussians:
        """See `SplatModel.moving`: every Gaussian of this model is of that form."""
        return moving_gaussians(self._raw(), self.harmonics())


def _time_degree(settings: Yang4DSettings) -> int:
    return settings.sh_time_degree if settings.temporal else 0


create, settings_from = Yang4D.create, Yang4D.settings_from

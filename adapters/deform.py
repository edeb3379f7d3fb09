"""From the bundled deformation backbone to the contract: points of an instant go into canonical space."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from d2_plugin.backbones.deform import Deform, initial_rows
from d2_plugin.protocol import Points

from .inverse_deformation import Inversion, invert_deformation
from .watched import WatchedModel

TOLERANCE = 0.5
"""Largest distance between a point and where its Gaussian really is at that instant, in standard deviations of the
Gaussian: one that is off by half of its own width still covers its pixel, whatever the unit of length."""

logger = logging.getLogger(__name__)


@dataclass
class Acceptance:
    """How often the inversion of the field came closer than the tolerance, over all insertions."""

    proposed: int = 0
    accepted: int = 0

    @property
    def rate(self) -> float:
        """Accepted share in 0..1; 1 before the first insertion."""
        return self.accepted / self.proposed if self.proposed else 1.0


class DeformAdapter(WatchedModel[Deform]):
    """One `Deform` instance as a `d2_plugin.protocol.Backbone`; `acceptance` counts what insertion achieved."""

    def __init__(self, model: Deform) -> None:
        super().__init__(model)
        self.acceptance = Acceptance()

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """Insert isotropic Gaussians that the field moves onto each point at the point's time; returns their number.

        Where the field cannot be inverted a Gaussian takes the offset of its nearest neighbour. The canonical scale
        makes up for the field's, so the Gaussian has the scale that was asked for at that instant.
        """
        canonical, log_scale_offsets = points.positions.clone(), torch.zeros_like(points.scales)
        for time in points.times.unique().tolist():
            chosen = torch.nonzero(points.times == time).squeeze(-1)
            inversion = self._invert(points.positions[chosen], points.scales[chosen], time)
            canonical[chosen] = inversion.positions
            log_scale_offsets[chosen] = self._log_scale_offsets(inversion.positions, time)
            self._count(inversion)
        scales = points.scales * torch.exp(-log_scale_offsets)
        self.model.append(initial_rows(canonical, points.colors, scales, points.opacities, self.model.settings))
        return len(canonical)

    def _invert(self, targets: Tensor, scales: Tensor, time: float) -> Inversion:
        present = self.model.gaussians["positions"].detach()
        moved = self._deformed(present, time)
        tolerance = TOLERANCE * scales
        return invert_deformation(lambda x: self._deformed(x, time), targets, moved, moved - present, tolerance)

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        offsets = self.model.offsets(positions, time)
        return positions if offsets is None else positions + offsets.positions

    def _log_scale_offsets(self, positions: Tensor, time: float) -> Tensor:
        offsets = self.model.offsets(positions, time)
        return positions.new_zeros(len(positions)) if offsets is None else offsets.log_scales.mean(-1)

    def _count(self, inversion: Inversion) -> None:
        self.acceptance.proposed += len(inversion.accepted)
        self.acceptance.accepted += int(inversion.accepted.sum())
        logger.info(
            "inverse deformation placed %d of %d points within tolerance (%.1f %% so far)",
            int(inversion.accepted.sum()),
            len(inversion.accepted),
            100 * self.acceptance.rate,
        )

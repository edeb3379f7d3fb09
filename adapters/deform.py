"""From the bundled deformation backbone to the contract: points of an instant go into canonical space."""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.backbones.deform import Deform
from d2_plugin.protocol import Points

from .inverse_deformation import invert_at_times
from .watched import WatchedModel


class DeformAdapter(WatchedModel[Deform]):
    """One `Deform` instance as a `d2_plugin.protocol.Backbone`."""

    @torch.no_grad()
    def insert(self, points: Points) -> int:
        """Insert isotropic Gaussians that the field moves onto each point at the point's time; returns their number.

        Where the field cannot be inverted a Gaussian takes the offset of its nearest neighbour. The canonical scale
        makes up for the field's, so the Gaussian has the scale that was asked for at that instant.
        """
        inversion = invert_at_times(points, self._deformed, self.model.gaussians["positions"].detach())
        scales = points.scales.clone()
        for time in points.times.unique().tolist():
            chosen = points.times == time
            offsets = self.model.offsets(inversion.positions[chosen], time)
            if offsets is not None:
                scales[chosen] *= torch.exp(-offsets.log_scales.mean(-1))
        return super().insert(points._replace(positions=inversion.positions, scales=scales))

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        offsets = self.model.offsets(positions, time)
        return positions if offsets is None else positions + offsets.positions

"""From the bundled Yang-style backbone to the contract."""

from __future__ import annotations

import torch

from d2_plugin.backbones.yang4d import Yang4D, initial_rows
from d2_plugin.protocol import Points

from .watched import WatchedModel


class Yang4DAdapter(WatchedModel[Yang4D]):
    """One `Yang4D` instance as a `d2_plugin.protocol.Backbone`."""

    def insert(self, points: Points) -> int:
        """Isotropic Gaussians at the points, living around the time of their frame; returns their number."""
        rows = initial_rows(*points[:5], self.model.settings, self.model.duration)
        if points.lifetimes is not None and "log_time_scales" in rows:
            rows["log_time_scales"] = torch.minimum(rows["log_time_scales"], points.lifetimes.log())
        self.model.append(rows)
        return len(points.positions)

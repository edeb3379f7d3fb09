"""WuJH2001/swift4d (ICLR 2025): 4DGaussians in which only the Gaussians that move are deformed, by a hash grid.

# train.py:118, in each stage
d2 = D2Hooks.attach("d2.toml", "swift4d", gaussians, scene, stage, iterations=train_iter)
loss = loss + d2.loss(iteration, viewpoint_cams)     # before :258, the whole batch
d2.step(iteration)                                   # after hash_optimizer.zero_grad (:340)
"""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.protocol import Points

from ..hust4d import Hust4DAdapter
from ..inria import InriaAdapter
from ..inverse_deformation import invert_some, values_of_neighbours

FULL_WEIGHT = 1.0
"""Largest compositing weight noted for a new row: `weight_prune` takes rows of low weight, also those never drawn."""


class Swift4DAdapter(Hust4DAdapter):
    """A `GaussianModel` of Swift4D as a `d2_plugin.protocol.Backbone`; arguments as `Hust4DAdapter` has them.

    Each Gaussian carries a logit `_dynamic`, learned between the two stages. In the fine one those above `dynamic_thro`
    go through `_FDhash`, whose offsets are added BEFORE the activations; the others stay as they are. The hash grid
    covers the box of the Gaussians with which the stage began; outside of it nothing is deformed.

    An inserted Gaussian takes over the logit of the one that is nearest at the time of its frame: it moves where its
    surroundings move.
    """

    evidence = InriaAdapter.evidence

    def _field(self, raw: tuple[Tensor, ...], time: float) -> tuple[Tensor, ...]:
        """Raw attributes of all rows at an instant; rows that do not move pass as they are."""
        moving = torch.nonzero(self._moves(self.gaussians._dynamic)).squeeze(-1)
        if not len(moving):
            return raw
        moved = self._hashed(tuple(part[moving] for part in raw), time)
        return tuple(part.index_copy(0, moving, now) for part, now in zip(raw, moved))

    def _hashed(self, raw: tuple[Tensor, ...], time: float) -> list[Tensor]:
        """What the hash grid makes of raw attributes; tiny-cuda-nn computes in half precision, the model does not."""
        times = raw[0].new_full((len(raw[0]), 1), time)
        return [now.to(part) for part, now in zip(raw, self.gaussians._FDhash(*raw, times))]

    def _moves(self, logits: Tensor) -> Tensor:
        return (logits > self.gaussians.dynamic_thro).squeeze(-1)

    def _append(self, points: Points) -> None:
        """Through its own function, which wants the logit and the largest weight of each new row as well."""
        model = self.gaussians
        logits = values_of_neighbours(points, lambda time: self._raw_at(time)[0], model._dynamic.detach())
        moving = self._moves(logits)
        if self.stage == "fine" and bool(moving.any()):
            points, self.inversion = invert_some(points, moving, self._deformed, model._xyz.detach())
        weights = points.scales.new_full((len(points.positions),), FULL_WEIGHT)
        model.densification_postfix(logits, *self._raw_rows(points), weights)

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        """Where rows at these positions would be if all of them moved."""
        return self._hashed(self._blank(positions), time)[0] if len(positions) else positions

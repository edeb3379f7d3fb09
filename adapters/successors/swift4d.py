"""WuJH2001/swift4d (ICLR 2025): 4DGaussians in which only the Gaussians that move are deformed, by a hash grid.

d2 = D2Hooks.attach("d2.toml", "swift4d", gaussians, scene, stage)   # train.py:118, in each stage
loss = loss + d2.loss(iteration, viewpoint_cams)                     # before :258, the whole batch
d2.step(iteration)                                                   # after hash_optimizer.zero_grad (:340)
"""

from __future__ import annotations

import torch
from torch import Tensor

from d2_plugin.protocol import Points

from ..hust4d import Hust4DAdapter
from ..inria import InriaAdapter
from ..inverse_deformation import invert_at_times, neighbour_offsets

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

    def _field(
        self, positions: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, time: float
    ) -> tuple[Tensor, ...]:
        """Raw attributes of all rows at an instant; rows that do not move pass as they are."""
        raw = positions, log_scales, rotations, logits
        moving = torch.nonzero(self._moves(self.gaussians._dynamic)).squeeze(-1)
        if not len(moving):
            return raw
        moved = self._moved(*(part[moving] for part in raw), time=time)
        return tuple(part.index_copy(0, moving, now) for part, now in zip(raw, moved))

    def _features_at(self, time: float) -> Tensor:
        """Harmonics [N, C, 3] of all rows in the fine stage; rows that do not move keep theirs."""
        model, features = self.gaussians, self._coefficients()
        moving = torch.nonzero(self._moves(model._dynamic)).squeeze(-1)
        if not len(moving):
            return features
        raw = model._xyz, model._scaling, model._rotation, model._opacity, features
        times = model._xyz.new_full((len(moving), 1), time)
        now = model._FDhash(*(part[moving] for part in raw), times)[4]
        return features.index_copy(0, moving, now.to(features))

    def _moved(self, *raw: Tensor, time: float) -> list[Tensor]:
        """What the hash grid makes of raw attributes; tiny-cuda-nn computes in half precision, the model does not."""
        positions = raw[0]
        times = positions.new_full((len(positions), 1), time)
        features = positions.new_zeros(len(positions), *self._feature_shape())
        fields = self.gaussians._FDhash(*raw, features, times)  # in the order positions, scales, rotations, opacities
        return [now.to(part) for part, now in zip(raw, fields)]

    def _moves(self, logits: Tensor) -> Tensor:
        return (logits > self.gaussians.dynamic_thro).squeeze(-1)

    def _append(self, points: Points) -> None:
        """Through its own function, which wants the logit and the largest weight of each new row as well."""
        logits = self._neighbours_logits(points)
        if self.stage == "fine" and bool(self._moves(logits).any()):
            points = self._canonical(points, self._moves(logits))
        weights = points.scales.new_full((len(points.positions),), FULL_WEIGHT)
        self.gaussians.densification_postfix(logits, *self._raw_rows(points), weights)

    def _neighbours_logits(self, points: Points) -> Tensor:
        """[K, 1], of the present Gaussian nearest to each point at the point's own time."""
        model, found = self.gaussians, self.gaussians._dynamic.new_zeros(len(points.positions), 1)
        if not len(self):
            return found
        for time in points.times.unique().tolist():
            chosen = points.times == time
            means = self._deformed(model._xyz, time) if self.stage == "fine" else model._xyz
            found[chosen] = neighbour_offsets(points.positions[chosen], means.detach(), model._dynamic.detach())
        return found

    def _canonical(self, points: Points, moving: Tensor) -> Points:
        """Points on what moves at the places that the field carries onto them; a place outside of its box stays."""
        chosen = points.select(moving)
        self.inversion = invert_at_times(chosen, self._as_new, self.gaussians._xyz.detach())
        positions = points.positions.clone()
        positions[moving] = self.inversion.positions
        return points._replace(positions=positions)

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        """Where the rows of the model are at an instant."""
        model = self.gaussians
        return self._field(positions, model._scaling, model._rotation, model._opacity, time)[0]

    def _as_new(self, positions: Tensor, time: float) -> Tensor:
        """Where rows at these positions would be if all of them moved."""
        zeros = positions.new_zeros
        count = len(positions)
        return self._moved(positions, zeros(count, 3), zeros(count, 4), zeros(count, 1), time=time)[0]

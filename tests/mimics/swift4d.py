"""After WuJH2001/swift4d: 4DGaussians, its loop too, with a logit per Gaussian: whether a hash grid deforms it."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from .hust4d import Scene, render, training
from .inria import InriaModel, cameras_of, started

__all__ = ["make", "render", "training"]


class SpaceTimeHashingField(nn.Module):
    """A network in half precision over the box of the points; outside of it nothing is deformed."""

    def __init__(self, xyz_bound_min: Tensor, xyz_bound_max: Tensor) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.hidden, self.heads = nn.Linear(4, 24), nn.Linear(24, 3 + 4 + 3 + 1)
        self.register_buffer("xyz_bound_min", xyz_bound_min)
        self.register_buffer("xyz_bound_max", xyz_bound_max)

    def get_params(self) -> list[nn.Parameter]:
        return list(self.parameters())

    def forward(self, xyz, scales, rotations, opacity, shs, time) -> tuple[Tensor, ...]:
        at = (xyz - self.xyz_bound_min).detach() / (self.xyz_bound_max - self.xyz_bound_min)
        inside = ((at >= 0) & (at <= 1)).all(1, keepdim=True).float()
        d = 0.1 * inside * self.heads(torch.tanh(3 * self.hidden(torch.cat([at, time], 1))))
        return xyz + d[:, :3], scales + d[:, 7:10], rotations + d[:, 3:7], opacity + d[:, 10:], shs


class GaussianModel(InriaModel):
    """The six columns, the logits in an optimizer of their own, and the largest weight of each Gaussian."""

    dynamic_thro = 0.0
    xyz_column, scaling_column = 1, 5

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        super().create_from_pcd(points, colors, scale)
        self._dynamic = nn.Parameter((torch.arange(len(points)) % 2).float()[:, None] - 0.5)
        self._max_weight = torch.zeros(len(points))

    def get_xyz_bound(self) -> tuple[Tensor, Tensor]:
        return self._xyz.detach().amin(0), self._xyz.detach().amax(0)

    def training_setup(self, training_args: SimpleNamespace) -> None:
        super().training_setup(training_args)
        self._FDhash = SpaceTimeHashingField(*self.get_xyz_bound())
        self.hash_optimizer = torch.optim.Adam(self._FDhash.get_params(), lr=1e-3)
        self.dy_optimizer = torch.optim.Adam([{"params": [self._dynamic], "lr": 0.05, "name": "dynamic"}])

    def _set_dynamic(self, value: Tensor) -> None:
        self._dynamic = nn.Parameter(value)
        self.dy_optimizer.param_groups[0]["params"] = [self._dynamic]

    def densification_postfix(self, *values: Tensor) -> None:
        new_dynamic, *rows, new_max_weight = values
        self._set_dynamic(torch.cat([self._dynamic.detach(), new_dynamic]))
        super().densification_postfix(*rows)
        self._max_weight = torch.cat([self._max_weight, new_max_weight])

    def rows_of(self, mask: Tensor, repeat: int = 1) -> list[Tensor]:
        rows = super().rows_of(mask, repeat)
        dynamic = self._dynamic.detach()[mask].repeat(repeat, 1)
        return [dynamic, *rows, self._max_weight[mask].repeat(repeat)]

    def prune_points(self, mask: Tensor) -> None:
        self._set_dynamic(self._dynamic.detach()[~mask])
        super().prune_points(mask)
        self._max_weight = self._max_weight[~mask]

    def deformed(self, time: float) -> tuple[Tensor, ...]:
        """Rows that do not move are put back beside those that the field returned."""
        dyn_mask = (self._dynamic > self.dynamic_thro).squeeze(1)
        raw = self._xyz, self._scaling, self._rotation, self._opacity
        shs = torch.cat([self._features_dc, self._features_rest], 1)[dyn_mask]
        times = torch.tensor(time).repeat(int(dyn_mask.sum()), 1)
        moved = self._FDhash(*(part[dyn_mask] for part in raw), shs, times)[:4]
        final = tuple(torch.zeros_like(part) for part in raw)
        for part, now, whole in zip(raw, moved, final):
            whole[dyn_mask], whole[~dyn_mask] = now, part[~dyn_mask]
        return final

    def add_densification_stats(self, gradient: Tensor, update_filter: Tensor) -> None:
        super().add_densification_stats(gradient, update_filter)
        self._max_weight = torch.max(self._max_weight, update_filter.float())

    def densify_and_prune(self, max_grad: float, min_opacity: float, extent: float, max_screen_size: object) -> None:
        super().densify_and_prune(max_grad, min_opacity, extent, max_screen_size)
        self.weight_prune(0.02)

    def weight_prune(self, weight_threshold: float) -> None:
        self.prune_points(self._max_weight < weight_threshold)
        self._max_weight = self._max_weight * 0.0


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(time=lambda view: view.time))

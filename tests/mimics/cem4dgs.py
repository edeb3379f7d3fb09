"""After tho-kn/cem-4dgs: one table of splats that are drawn, and one of motions that carry some of them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from . import ex4dgs
from .ex4dgs import Scene, render, training
from .fastergs4d import product
from .inria import InriaModel, cameras_of, started

__all__ = ["make", "render", "training"]

STATIC = (
    *InriaModel.columns,
    ("xyz_disp", "_xyz_disp"),
    ("opacity_center", "_opacity_duration_center"),
    ("opacity_var", "_opacity_duration_var"),
)
MOTION = (("motion_xyz", "_xyz_motion"), ("motion_rotation", "_rotation_motion"))


class GaussianModel(ex4dgs.GaussianModel):
    """Splats of level 0 drift; those of level 1 hang on a motion, whose number in the joint table is their parent."""

    columns, static_columns = (*STATIC, *MOTION), STATIC
    rgb, rates = InriaModel.rgb, InriaModel.rates

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        InriaModel.create_from_pcd(self, points, colors, scale)
        count = len(points)
        span = torch.zeros(count, 2, 1)
        span[:, 1] = 1
        self._set("_xyz_disp", torch.zeros(count, 3))
        self._set("_opacity_duration_center", span)
        self._set("_opacity_duration_var", torch.ones(count, 2, 1))
        self._set("_xyz_motion", torch.empty(0, 2, 3))
        self._set("_rotation_motion", torch.empty(0, 2, 4))
        self._parent, self._level = torch.full((count, 1), -1), torch.zeros(count, 1, dtype=torch.long)

    def _joint(self, t: float) -> tuple[Tensor, Tensor]:
        """Positions and rotations of splats and motions together, children carried by their parents."""
        moved = self._xyz_motion[:, 0] * (1 - t) + self._xyz_motion[:, 1] * t
        turned = self._rotation_motion[:, 0] * (1 - t) + self._rotation_motion[:, 1] * t
        xyz = torch.cat([self._xyz, moved])
        rotation = nn.functional.normalize(torch.cat([self._rotation, turned]))
        child = torch.nonzero(self._level[:, 0] != 0).squeeze(1)
        parent = self._parent[child, 0]
        q, v = rotation[parent], torch.cat([xyz.new_zeros(len(child), 1), xyz[child]], 1)
        carried = product(product(q, v), q * q.new_tensor([1.0, -1, -1, -1]))[:, 1:]
        xyz = xyz.index_copy(0, child, xyz[parent] + carried)
        return xyz, rotation.index_copy(0, child, product(q, rotation[child]))

    def get_xyz_at_t(self, t: float) -> Tensor:
        return self._joint(t)[0][: len(self._xyz)] + self._xyz_disp * t / self.duration

    def get_rotation_at_t(self, t: float) -> Tensor:
        return self._joint(t)[1][: len(self._xyz)]

    def get_scaling(self) -> Tensor:
        return self._scaling.exp()

    def get_opacity_at_t(self, t: float) -> Tensor:
        span = (t - self._opacity_duration_center).amin(1) / self._opacity_duration_var.exp().amax(1)
        child = self._level[: len(self._xyz)] > 0
        return torch.sigmoid(self._opacity) * torch.where(child, torch.exp(-span * span), torch.ones_like(span))

    def prune_points(self, static_mask: Tensor, dynamic_mask: Tensor | None = None) -> None:
        count = len(self._xyz)
        if dynamic_mask is None:
            dynamic_mask = torch.zeros(len(self._xyz_motion), dtype=torch.bool)
        living = self._parent[:count][(self._level[:count] > 0) & ~static_mask[:, None]]
        assert (living >= count).all(), "only motions are parents"
        dynamic_mask[living.unique() - count] = False
        keep = torch.cat([~static_mask, ~dynamic_mask])
        renumbered = torch.cat([torch.cumsum(keep, 0) - 1, torch.tensor([-1])])  # the last for parents of -1
        self._parent, self._level = renumbered[self._parent[keep]], self._level[keep]
        self._keep(~static_mask, ~dynamic_mask)

    def densify_and_clone(self, grads: Tensor, threshold: float, extent: float) -> None:
        """The errors, parents and levels are lengthened by the caller, splats before motions."""
        chosen, count = grads.norm(dim=-1) >= threshold, len(self._xyz)
        self.xyz_error_min = torch.cat([self.xyz_error_min, self.xyz_error_min[chosen]])
        self.xyz_error_min_timestamp = torch.cat([self.xyz_error_min_timestamp, self.xyz_error_min_timestamp[chosen]])
        for name in ("_parent", "_level"):
            joint = getattr(self, name)
            setattr(self, name, torch.cat([joint[:count], joint[:count][chosen], joint[count:]]))
        self._parent[self._parent >= count] += int(chosen.sum())
        self.densification_postfix_onlystatic(*(getattr(self, attribute)[chosen] for _, attribute in STATIC))

    def densify_and_prune(self, max_grad: float, min_opacity: float, extent: float, max_screen_size: object) -> None:
        self.densify_and_clone((self.xyz_gradient_accum / self.denom).nan_to_num(), max_grad, extent)
        self.prune_points(torch.sigmoid(self._opacity).squeeze(-1) < min_opacity)

    def extract_dynamic_points_from_static(self, share: float = 0.1) -> None:
        """The fastest still splats become children of a motion each, at its origin."""
        count = len(self._xyz)
        drift = self._xyz_disp.norm(dim=-1)
        still = self._level[:count, 0] == 0
        moving = torch.nonzero((drift > torch.quantile(drift, 1 - share)) & still).squeeze(1)
        rows = torch.stack([self._xyz, self._xyz + self._xyz_disp], 1)[moving].detach()
        identity = torch.zeros(len(moving), 2, 4)
        identity[..., 0] = 1
        first = len(self._parent)
        self.cat_tensors_to_optimizer({"motion_xyz": rows, "motion_rotation": identity})
        self._parent[moving, 0] = torch.arange(len(moving)) + first
        self._level[moving] = 1
        self._parent = torch.cat([self._parent, torch.full((len(moving), 1), -1)])
        self._level = torch.cat([self._level, torch.zeros(len(moving), 1, dtype=torch.long)])
        self._xyz.data[moving] = 0.0
        self._xyz_disp.data[moving] = 0.0


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(timestamp=lambda view: view.frame))

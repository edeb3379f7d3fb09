"""After WuJH2001/swift4d: 4DGaussians with a logit per Gaussian that says whether a hash grid deforms it."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from .hust4d import Scene
from .inria import InriaModel, cameras_of, default_options, densify, draw_all, l1_loss, shuffled, started


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

    def training_setup(self, training_args: SimpleNamespace, args: object = None) -> None:
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

    def weight_prune(self, weight_threshold: float) -> None:
        self.prune_points(self._max_weight < weight_threshold)
        self._max_weight = self._max_weight * 0.0


def render(viewpoint_camera, pc, bg_color, stage="fine") -> dict[str, Tensor]:
    """Depth without alpha; rows that do not move are put back beside those that the field returned."""
    means, scales, rotations, opacity = pc._xyz, pc._scaling, pc._rotation, pc._opacity
    if stage == "fine":
        dyn_mask = (pc._dynamic > pc.dynamic_thro).squeeze(1)
        time = torch.tensor(viewpoint_camera.time).repeat(int(dyn_mask.sum()), 1)
        raw = (means, scales, rotations, opacity)
        shs = torch.cat([pc._features_dc, pc._features_rest], 1)[dyn_mask]
        moved = pc._FDhash(*(part[dyn_mask] for part in raw), shs, time)[:4]
        final = [torch.zeros_like(part) for part in raw]
        for part, now, whole in zip(raw, moved, final):
            whole[dyn_mask], whole[~dyn_mask] = now, part[~dyn_mask]
        means, scales, rotations, opacity = final
    rotations = nn.functional.normalize(rotations)
    package = draw_all(pc, viewpoint_camera, bg_color, means, scales.exp(), rotations, torch.sigmoid(opacity))
    return package | {"max_weight_t": package["visibility_filter"].float()}


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(time=lambda view: view.time))


def training(gaussians: GaussianModel, scene: Scene, opt=None, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    opt = opt or default_options()
    if checkpoint is None:
        scene_reconstruction(gaussians, scene, "coarse", opt, None, min(20, stop))
    return scene_reconstruction(gaussians, scene, "fine", opt, checkpoint, stop)


def scene_reconstruction(gaussians, scene, stage, opt, checkpoint, stop, args=None) -> SimpleNamespace:
    dataset, first_iter, train_iter = SimpleNamespace(white_background=False), 0, opt.iterations
    gaussians.training_setup(opt, args)
    if checkpoint:
        (model_params, first_iter) = checkpoint
        gaussians.restore(model_params, opt)

    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    for iteration in range(first_iter + 1, min(train_iter, stop) + 1):
        torch.manual_seed(iteration)
        stack = scene.getTrainCameras()
        viewpoint_cams = [stack[i] for i in shuffled(len(stack), iteration)[: opt.batch_size]]
        packages = [render(viewpoint_cam, gaussians, bg_color, stage) for viewpoint_cam in viewpoint_cams]
        radii = torch.stack([package["radii"] for package in packages]).amax(0)
        visibility_filter = torch.stack([package["visibility_filter"] for package in packages]).any(0)
        last_max_weight = torch.stack([package["max_weight_t"] for package in packages]).amax(0)
        image_tensor = torch.stack([package["render"] for package in packages])
        gt_image_tensor = torch.stack([camera.original_image for camera in viewpoint_cams])
        loss = l1_loss(image_tensor, gt_image_tensor)
        loss.backward()
        viewspace_point_tensor_grad = sum(package["viewspace_points"].grad for package in packages)
        with torch.no_grad():
            gaussians._max_weight = torch.max(gaussians._max_weight, last_max_weight)
            densify(gaussians, opt, iteration, viewspace_point_tensor_grad, visibility_filter, radii)
            if iteration < opt.densify_until_iter and iteration % 31 == 0:
                gaussians.weight_prune(0.02)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none = True)
                gaussians.hash_optimizer.step()
                gaussians.hash_optimizer.zero_grad(set_to_none = True)
    return SimpleNamespace(**locals())

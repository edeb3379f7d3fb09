"""After hustvl/4DGaussians: a deformation of raw attributes, two stages, one backward for the whole batch."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from . import inria
from .inria import InriaModel, cameras_of, default_options, densify, draw_all, l1_loss, set_up, shuffled, started


class DeformNetwork(nn.Module):
    """Planes over (x, y) and (z, t), a small decoder; offsets are added to raw attributes."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.planes = nn.ParameterList([nn.Parameter(1 + 0.3 * torch.randn(1, 6, 8, 8)) for _ in range(2)])
            self.decoder = nn.Linear(6, 3 + 3 + 4 + 1)
        self.aabb = torch.tensor([[2.0, 1.5, 5.0], [-2.0, -1.5, 1.0]])

    @property
    def get_aabb(self) -> tuple[Tensor, Tensor]:
        return self.aabb[0], self.aabb[1]

    def forward(self, point, scales, rotations, opacity, shs, times_sel) -> tuple[Tensor, ...]:
        unit = (point - self.aabb[0]) * (2.0 / (self.aabb[1] - self.aabb[0])) - 1.0
        pairs = unit[:, :2], torch.cat([unit[:, 2:], times_sel], -1)
        looked = [
            nn.functional.grid_sample(plane, at[None, None], align_corners=True, padding_mode="border")[0, :, 0].T
            for plane, at in zip(self.planes, pairs)
        ]
        offset = 0.1 * self.decoder(looked[0] * looked[1])
        return (
            point + offset[:, :3], scales + offset[:, 3:6], rotations + offset[:, 6:10], opacity + offset[:, 10:], shs
        )  # fmt: skip


class GaussianModel(InriaModel):
    """The six columns, a field, a table of what is deformed, and an accumulator of deformations."""

    def __init__(self) -> None:
        super().__init__()
        self._deformation = DeformNetwork()

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        super().create_from_pcd(points, colors, scale)
        self._deformation_table = torch.ones(len(points), dtype=torch.bool)

    def deformed(self, time: float) -> tuple[Tensor, ...]:
        """Raw positions, scales, rotations and opacities at a time."""
        shs = torch.cat([self._features_dc, self._features_rest], 1)
        times = torch.tensor(time).repeat(self._xyz.shape[0], 1)
        return self._deformation(self._xyz, self._scaling, self._rotation, self._opacity, shs, times)[:4]

    def _zero_accumulators(self) -> None:
        super()._zero_accumulators()
        self._deformation_accum = torch.zeros(len(self._xyz), 3)

    def further_groups(self, opt: SimpleNamespace) -> list[dict[str, object]]:
        field = self._deformation
        return [
            {"params": list(field.decoder.parameters()), "lr": 1e-3, "name": "deformation"},
            {"params": list(field.planes.parameters()), "lr": 1e-2, "name": "grid"},
        ]

    def densification_postfix(self, *values: Tensor) -> None:
        *rows, new_deformation_table = values
        super().densification_postfix(*rows)
        self._deformation_table = torch.cat([self._deformation_table, new_deformation_table], -1)

    def rows_of(self, mask: Tensor, repeat: int = 1) -> list[Tensor]:
        return [*super().rows_of(mask, repeat), self._deformation_table[mask].repeat(repeat)]

    def prune_points(self, mask: Tensor) -> None:
        super().prune_points(mask)
        self._deformation_accum = self._deformation_accum[~mask]
        self._deformation_table = self._deformation_table[~mask]


class Scene(inria.Scene):
    """Cameras that only know their place in the data set; the paths are with the data set."""

    def __init__(self, cameras: list[inria.Camera]) -> None:
        paths = [f"/data/scene/{name[:4]}/images/{name[5:]}.png" for name in (c.image_name for c in cameras)]
        for index, camera in enumerate(cameras):
            camera.image_name, camera.uid = f"{index}", index
        self.train_camera, self.cameras = SimpleNamespace(dataset=SimpleNamespace(image_paths=paths)), cameras


def render(viewpoint_camera, pc, bg_color, stage="fine") -> dict[str, Tensor]:
    """Depth without alpha, as in the repository."""
    still = pc._xyz, pc._scaling, pc._rotation, pc._opacity
    means, scales, rotations, opacity = pc.deformed(viewpoint_camera.time) if stage == "fine" else still
    rotations = nn.functional.normalize(rotations)
    return draw_all(pc, viewpoint_camera, bg_color, means, scales.exp(), rotations, torch.sigmoid(opacity))


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(time=lambda view: view.time))


def training(gaussians: GaussianModel, scene: Scene, opt=None, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    opt = opt or default_options()
    if checkpoint is None:
        scene_reconstruction(gaussians, scene, "coarse", opt, None, stop, 5)
    return scene_reconstruction(gaussians, scene, "fine", opt, checkpoint, stop, opt.iterations)


def scene_reconstruction(gaussians, scene, stage, opt, checkpoint, stop, train_iter) -> SimpleNamespace:
    dataset, first_iter = SimpleNamespace(white_background=False), set_up(gaussians, opt, checkpoint)

    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    for iteration in range(first_iter + 1, min(train_iter, stop) + 1):
        torch.manual_seed(iteration)
        stack = scene.getTrainCameras()
        viewpoint_cams = [stack[i] for i in shuffled(len(stack), iteration)[: opt.batch_size]]
        packages = [render(viewpoint_cam, gaussians, bg_color, stage) for viewpoint_cam in viewpoint_cams]
        radii = torch.stack([package["radii"] for package in packages]).amax(0)
        visibility_filter = torch.stack([package["visibility_filter"] for package in packages]).any(0)
        image_tensor = torch.stack([package["render"] for package in packages])
        gt_image_tensor = torch.stack([camera.original_image for camera in viewpoint_cams])
        loss = l1_loss(image_tensor, gt_image_tensor)
        loss.backward()
        viewspace_point_tensor_grad = sum(package["viewspace_points"].grad for package in packages)
        with torch.no_grad():
            densify(gaussians, opt, iteration, viewspace_point_tensor_grad, visibility_filter, radii)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none = True)
                if hasattr(gaussians, "hash_optimizer"):
                    gaussians.hash_optimizer.step()
                    gaussians.hash_optimizer.zero_grad(set_to_none = True)
    return SimpleNamespace(**locals())

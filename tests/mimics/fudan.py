"""After fudan-zvg/4d-gaussian-splatting: native 4D Gaussians, several views per iteration with one backward each."""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from torch import Tensor

from d2_plugin.gaussians.slicing import slice_gaussians

from .inria import Camera, InriaModel, cameras_of, default_options, densify, draw, l1_loss, set_up, shuffled, started


class GaussianModel(InriaModel):
    """gaussian_dim 4 with rot_4d."""

    columns = (*InriaModel.columns, ("t", "_t"), ("scaling_t", "_scaling_t"), ("rotation_r", "_rotation_r"))
    rates = InriaModel.rates | {"t": 2e-3, "scaling_t": 1e-2, "rotation_r": 2e-3}
    accumulated = ("xyz_gradient_accum", "denom", "t_gradient_accum")

    def __init__(self, time_duration: tuple[float, float] = (0.0, 0.5)) -> None:
        super().__init__()
        self.gaussian_dim, self.rot_4d, self.prefilter_var, self.time_duration = 4, True, -1.0, list(time_duration)

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        super().create_from_pcd(points, colors, scale)
        start, stop = self.time_duration
        self._set("_t", torch.linspace(start, stop, len(points))[:, None].clone())
        self._set("_scaling_t", torch.full((len(points), 1), 0.5 * math.log((stop - start) / 5)))
        self._set("_rotation_r", self._rotation.detach().clone())


class Scene:
    """Cameras by resolution scale, as the repository keeps them."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.train_cameras, self.test_cameras = {1.0: cameras}, {1.0: []}

    def getTrainCameras(self) -> list[tuple[Tensor, Camera]]:
        return [(camera.original_image, camera) for camera in self.train_cameras[1.0]]


def render(viewpoint_camera: Camera, pc: GaussianModel, bg_color: list[int]) -> dict[str, Tensor]:
    raw = {
        "positions": pc._xyz, "log_scales": pc._scaling, "left": pc._rotation,
        "opacity_logits": pc._opacity.squeeze(-1), "times": pc._t.squeeze(-1),
        "log_time_scales": pc._scaling_t.squeeze(-1), "right": pc._rotation_r,
    }  # fmt: skip
    splats = slice_gaussians(raw, viewpoint_camera.timestamp)
    return draw(splats, pc.rgb[splats.rows], viewpoint_camera, len(pc._xyz), bg_color)


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(timestamp=lambda view: view.time))


def training(gaussians: GaussianModel, scene: Scene, opt=None, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    opt, dataset = opt or default_options(), SimpleNamespace(white_background=False)
    batch_size, first_iter = opt.batch_size, set_up(gaussians, opt, checkpoint)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    training_dataset = scene.getTrainCameras()
    for iteration in range(first_iter + 1, min(opt.iterations, stop) + 1):
        torch.manual_seed(iteration)
        order = shuffled(len(training_dataset), iteration)
        batch_point_grad, batch_visibility_filter, batch_radii = [], [], []
        for batch_idx in range(batch_size):
            gt_image, viewpoint_cam = training_dataset[order[batch_idx]]
            viewpoint_cam = viewpoint_cam.cuda()
            render_pkg = render(viewpoint_cam, gaussians, bg_color)
            image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
            loss = l1_loss(image, gt_image)
            loss = loss / batch_size
            loss.backward()
            batch_point_grad.append(viewspace_point_tensor.grad[:, :2].norm(dim=-1))
            batch_radii.append(render_pkg["radii"])
            batch_visibility_filter.append(render_pkg["visibility_filter"])
        visibility_count = torch.stack(batch_visibility_filter, 1).sum(1)
        visibility_filter = visibility_count > 0
        radii = torch.stack(batch_radii, 1).amax(1)
        batch_viewspace_point_grad = torch.stack(batch_point_grad, 1).sum(1)
        batch_viewspace_point_grad[visibility_filter] *= batch_size / visibility_count[visibility_filter]
        with torch.no_grad():
            densify(gaussians, opt, iteration, batch_viewspace_point_grad.unsqueeze(1), visibility_filter, radii)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none = True)
    return SimpleNamespace(**locals())

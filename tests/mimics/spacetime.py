"""After oppo-us-research/SpacetimeGaussians: temporal radial basis, cubic motion, gradients cached over a batch."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from . import inria
from .inria import Camera, InriaModel, cameras_of, default_options, densify, draw_all, l1_loss, shuffled, started


class GaussianModel(InriaModel):
    """The full model, its decoder left out."""

    columns = (
        ("xyz", "_xyz"), ("f_dc", "_features_dc"), ("opacity", "_opacity"), ("scaling", "_scaling"),
        ("rotation", "_rotation"), ("trbf_center", "_trbf_center"), ("trbf_scale", "_trbf_scale"),
        ("motion", "_motion"), ("omega", "_omega"), ("f_t", "_features_t"),
    )  # fmt: skip
    scaling_column = 3

    def __init__(self) -> None:
        super().__init__()
        self.trbfslinit, self.omegamask = -0.5, None

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        super().create_from_pcd(points, colors, scale)
        count = len(points)
        self._set("_features_dc", torch.tensor(colors, dtype=torch.float32).repeat(1, 2))
        self._set("_trbf_center", torch.linspace(0, 1, count)[:, None].clone())
        self._set("_trbf_scale", torch.full((count, 1), self.trbfslinit))
        for name, width in (("_motion", 9), ("_omega", 4), ("_features_t", 3)):
            self._set(name, torch.zeros(count, width))

    @property
    def rgb(self) -> Tensor:
        return self._features_dc[:, :3] + 0 * self._features_dc[:, 3:] + 0 * self._features_t

    def get_rotation(self, delta_t: Tensor) -> Tensor:
        return nn.functional.normalize(self._rotation + delta_t * self._omega)

    def prune_points(self, mask: Tensor) -> None:
        super().prune_points(mask)
        if self.omegamask is not None:
            self.omegamask = self.omegamask[~mask]

    def zero_gradient_cache(self) -> None:
        self._cache = {attribute: torch.zeros_like(getattr(self, attribute)) for _, attribute in self.columns}

    def cache_gradient(self) -> None:
        for attribute, total in self._cache.items():
            total += getattr(self, attribute).grad.clone()

    def set_batch_gradient(self, cnt: int) -> None:
        for attribute, total in self._cache.items():
            getattr(self, attribute).grad = total / cnt


class Scene(inria.Scene):
    def __init__(self, cameras: list[Camera]) -> None:
        for camera in cameras:
            camera.image_name = camera.image_name[:4]
        super().__init__(cameras)


def render(viewpoint_camera, pc, bg_color) -> dict[str, Tensor]:
    """Median depth, as its rasterizers give it, without alpha."""
    offset = viewpoint_camera.timestamp - pc._trbf_center
    pc.trbfoutput = torch.exp(-((offset / pc._trbf_scale.exp()) ** 2))
    opacity = pc.get_opacity * pc.trbfoutput
    d = offset.detach()
    motion = pc._motion
    means = pc.get_xyz + motion[:, 0:3] * d + motion[:, 3:6] * d * d + motion[:, 6:9] * d * d * d
    return draw_all(pc, viewpoint_camera, bg_color, means, pc.get_scaling, pc.get_rotation(d), opacity)


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(timestamp=lambda view: view.frame / 2))


def training(gaussians: GaussianModel, scene: Scene, opt=None, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    opt, dataset = opt or default_options(), SimpleNamespace(white_background=False)
    duration, (model_params, first_iter) = 2, checkpoint or ({}, 0)
    gaussians.restore(model_params, opt)  # as many Gaussians as there were, before anything attaches
    gaussians.training_setup(opt)

    gaussians.restore(model_params, opt)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    cameras = scene.getTrainCameras()
    traincamdict = {i: [cam for cam in cameras if cam.timestamp == i / duration] for i in range(duration)}
    for iteration in range(first_iter + 1, min(opt.iterations, stop) + 1):
        torch.manual_seed(iteration)
        gaussians.zero_gradient_cache()
        viewpointset = traincamdict[shuffled(duration, iteration)[0]]
        for i in shuffled(len(viewpointset), iteration)[: opt.batch_size]:
            viewpoint_cam = viewpointset[i]
            render_pkg = render(viewpoint_cam, gaussians, bg_color)
            loss = l1_loss(render_pkg["render"], viewpoint_cam.original_image)
            loss.backward()
            gaussians.cache_gradient()
            gaussians.optimizer.zero_grad(set_to_none = True)#
        gaussians.set_batch_gradient(opt.batch_size)
        with torch.no_grad():
            seen, radii = render_pkg["visibility_filter"], render_pkg["radii"]
            densify(gaussians, opt, iteration, render_pkg["viewspace_points"].grad, seen, radii)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none = True)
    return SimpleNamespace(**locals())

"""After ingra14m/Deformable-3D-Gaussians: canonical Gaussians and an MLP with an optimizer of its own."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from . import inria
from .inria import InriaModel, cameras_of, default_options, densify, draw_all, l1_loss, restore, shuffled, started

GaussianModel = InriaModel


class DeformNetwork(nn.Module):
    """Positional encoding, one hidden layer, three heads; `is_6dof` returns rigid motions."""

    def __init__(self, is_6dof: bool = False) -> None:
        super().__init__()
        self.is_6dof = is_6dof
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.linear = nn.Linear(4 * 5, 24)
            self.gaussian_warp, self.gaussian_rotation, self.gaussian_scaling = (nn.Linear(24, n) for n in (3, 4, 3))

    def forward(self, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        inputs = torch.cat([x, t], -1)
        h = torch.cat([inputs] + [f(2**k * inputs) for k in range(2) for f in (torch.sin, torch.cos)], -1)
        h = torch.relu(self.linear(h))
        d_xyz = 0.3 * self.gaussian_warp(h)
        if self.is_6dof:
            motion = torch.eye(4).repeat(len(x), 1, 1)
            motion[:, :3, 3] = d_xyz
            motion[:, 0, 1], motion[:, 1, 0] = -0.1 * d_xyz[:, 0], 0.1 * d_xyz[:, 0]
            d_xyz = motion
        return d_xyz, 0.2 * self.gaussian_rotation(h), 0.02 * self.gaussian_scaling(h)


class DeformModel:
    def __init__(self, is_blender: bool = True, is_6dof: bool = False) -> None:
        self.deform, self.optimizer = DeformNetwork(is_6dof), None

    def step(self, xyz: Tensor, time_emb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.deform(xyz, time_emb)

    def train_setting(self, opt: SimpleNamespace) -> None:
        group = {"params": list(self.deform.parameters()), "lr": opt.position_lr_init, "name": "deform"}
        self.optimizer = torch.optim.Adam([group], lr=0.0, eps=1e-15)

    def update_learning_rate(self, iteration: int) -> None:
        self.optimizer.param_groups[0]["lr"] *= 0.999


def render(viewpoint_camera, pc, bg_color, d_xyz, d_rotation, d_scaling, is_6dof=False) -> dict[str, Tensor]:
    """Depth without alpha, as in the repository; the sum of q and d_rotation is not normalised."""
    if is_6dof and torch.is_tensor(d_xyz):
        means = (d_xyz @ torch.cat([pc.get_xyz, torch.ones(len(pc.get_xyz), 1)], 1)[..., None])[:, :3, 0]
    else:
        means = pc.get_xyz + d_xyz
    rotations = nn.functional.normalize(pc._rotation) + d_rotation
    package = draw_all(pc, viewpoint_camera, bg_color, means, pc.get_scaling + d_scaling, rotations, pc.get_opacity)
    return package | {"viewspace_points_densify": package["viewspace_points"]}


def make(is_6dof: bool = False) -> tuple[GaussianModel, DeformModel, inria.Scene]:
    cameras = cameras_of(fid=lambda view: torch.tensor([view.time]))
    return started(GaussianModel()), DeformModel(is_6dof=is_6dof), inria.Scene(cameras)


def training(
    gaussians: GaussianModel, deform: DeformModel, scene: inria.Scene, opt=None, checkpoint=None, stop: int = 10**9
) -> SimpleNamespace:
    """The repository saves no optimizer, so `checkpoint` is what one would add to resume at all."""
    opt, dataset = opt or default_options(), SimpleNamespace(white_background=False)
    (model_params, deform_params), first_iter = checkpoint or (({}, {}), 0)
    deform.train_setting(opt)
    restore(deform, deform_params)
    gaussians.restore(model_params, opt)  # as many Gaussians as there were, before anything attaches
    gaussians.training_setup(opt)

    gaussians.restore(model_params, opt)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    for iteration in range(first_iter + 1, min(opt.iterations, stop) + 1):
        torch.manual_seed(iteration)
        viewpoint_stack = scene.getTrainCameras()
        viewpoint_cam = viewpoint_stack[shuffled(len(viewpoint_stack), iteration)[0]]
        fid = viewpoint_cam.fid
        if iteration < opt.warm_up:
            d_xyz, d_rotation, d_scaling = 0.0, 0.0, 0.0
        else:
            time_input = fid.unsqueeze(0).expand(len(gaussians.get_xyz), -1)
            d_xyz, d_rotation, d_scaling = deform.step(gaussians.get_xyz.detach(), time_input)
        render_pkg_re = render(viewpoint_cam, gaussians, bg_color, d_xyz, d_rotation, d_scaling, deform.deform.is_6dof)
        image, visibility_filter, radii = (render_pkg_re[k] for k in ("render", "visibility_filter", "radii"))
        loss = l1_loss(image, viewpoint_cam.original_image)
        loss.backward()
        with torch.no_grad():
            gradient = render_pkg_re["viewspace_points_densify"].grad
            densify(gaussians, opt, iteration, gradient, visibility_filter, radii)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                deform.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
                deform.optimizer.zero_grad()
                deform.update_learning_rate(iteration)
    return SimpleNamespace(**locals())

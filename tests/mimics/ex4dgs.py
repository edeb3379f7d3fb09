"""After juno181/Ex4DGS: a static table with a drift, a dynamic one between key frames, edited together."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from d2_plugin.rasterizer import RasterSettings, Splats

from . import inria
from .inria import InriaModel, cameras_of, covariances, default_options, densify, draw, l1_loss, shuffled, started

STATIC = (*InriaModel.columns, ("xyz_disp", "_xyz_disp"))
DYNAMIC = (
    ("motion_xyz", "_xyz_motion"), ("motion_f_dc", "_features_dc_motion"), ("motion_f_rest", "_features_rest_motion"),
    ("motion_scaling", "_scaling_motion"), ("motion_opacity", "_opacity_motion"),
    ("motion_opacity_center", "_opacity_duration_center"), ("motion_opacity_var", "_opacity_duration_var"),
    ("motion_rotation", "_rotation_motion"),
)  # fmt: skip


class GaussianModel(InriaModel):
    """Two key frames, at the two frames of the tiny scene; the error statistics that select dynamic ones."""

    columns, static_columns = (*STATIC, *DYNAMIC), STATIC
    rates = InriaModel.rates | {f"motion_{name}": rate for name, rate in InriaModel.rates.items()} | {"xyz_disp": 2e-2}
    accumulated = ("xyz_gradient_accum", "denom", "xyz_error_accum", "xyz_ssim_error_accum", "error_denom")
    kept = ("xyz_error_min", "xyz_error_min_timestamp", "min_radii2D")
    kernel_size, duration, time_shift = 0.1, 1, 1

    def create_from_pcd(self, points, colors, scale: float = 0.15) -> None:
        super().create_from_pcd(points, colors, scale)
        self._set("_xyz_disp", torch.zeros(len(points), 3))
        shapes = ((2, 3), (1, 3), (15, 3), (3,), (1,), (2, 1), (2, 1), (2, 4))
        for (_, attribute), shape in zip(DYNAMIC, shapes):
            self._set(attribute, torch.empty(0, *shape))

    def training_setup(self, training_args: SimpleNamespace) -> None:
        super().training_setup(training_args)
        count = len(self._xyz)
        self.xyz_error_min, self.xyz_error_min_timestamp = torch.full((count, 1), 1000.0), torch.full((count, 1), -1.0)
        self.min_radii2D = torch.full((count,), 1000.0)

    def get_xyz_at_t(self, t: float) -> Tensor:
        assert -self.time_shift <= t <= self.duration + self.time_shift
        dynamic = self._xyz_motion[:, 0] * (1 - t) + self._xyz_motion[:, 1] * t
        return torch.cat([self._xyz + self._xyz_disp * t / self.duration, dynamic])

    def get_rotation_at_t(self, t: float) -> Tensor:
        dynamic = self._rotation_motion[:, 0] * (1 - t) + self._rotation_motion[:, 1] * t
        return torch.cat([self._rotation, nn.functional.normalize(dynamic)])

    def get_scaling(self) -> Tensor:
        return torch.cat([self._scaling, self._scaling_motion]).exp()

    def get_opacity_at_t(self, t: float) -> Tensor:
        span = (t - self._opacity_duration_center).amin(1) / self._opacity_duration_var.exp().amax(1)
        return torch.sigmoid(torch.cat([self._opacity, self._opacity_motion * torch.exp(-span * span)]))

    @property
    def rgb(self) -> Tensor:
        dc = torch.cat([self._features_dc, self._features_dc_motion])
        rest = torch.cat([self._features_rest, self._features_rest_motion])
        return (0.5 + 0.282 * dc[:, 0] + 0 * rest.sum((1, 2))[:, None]).clamp_min(0)

    def prune_points(self, static_mask: Tensor, dynamic_mask: Tensor) -> None:
        if dynamic_mask.shape[0] == 0:
            dynamic_mask = torch.empty(0, dtype=torch.bool)
        self._keep(~static_mask, ~dynamic_mask)

    def _keep(self, static: Tensor, dynamic: Tensor) -> None:
        for name, _ in self.columns:
            keep = dynamic if name.startswith("motion_") else static
            self._change(name, lambda rows: rows[keep], lambda rows: rows[keep])  # noqa: B023
        for name in (*self.accumulated, *self.kept, "max_radii2D"):
            setattr(self, name, getattr(self, name)[static])

    def _added(self, columns: tuple[tuple[str, str], ...], values: tuple[Tensor, ...]) -> None:
        assert len(values) == len(columns)
        self.cat_tensors_to_optimizer({name: value for (name, _), value in zip(columns, values)})
        self._zero_accumulators()
        self.max_radii2D = torch.zeros(len(self._xyz))
        self.min_radii2D = torch.full((len(self._xyz),), 1000.0)

    def densification_postfix(self, *values: Tensor) -> None:
        """Raw rows of both tables, in the order of the columns; the errors are the caller's."""
        self._added(self.columns, values)

    def densification_postfix_onlystatic(self, *values: Tensor) -> None:
        self._added(self.static_columns, values)

    def densify_and_clone(self, grads: Tensor, threshold: float, extent: float) -> None:
        chosen = grads.norm(dim=-1) >= threshold
        self.xyz_error_min = torch.cat([self.xyz_error_min, self.xyz_error_min[chosen]])
        self.xyz_error_min_timestamp = torch.cat([self.xyz_error_min_timestamp, self.xyz_error_min_timestamp[chosen]])
        rows = [getattr(self, attribute)[chosen] for _, attribute in STATIC]
        if not len(self._xyz_motion):
            self.densification_postfix_onlystatic(*rows)
            return
        moving = torch.arange(len(self._xyz_motion)) % 4 == 0
        self.densification_postfix(*rows, *(getattr(self, attribute)[moving] for _, attribute in DYNAMIC))

    def densify_and_prune(self, max_grad: float, min_opacity: float, extent: float, max_screen_size: object) -> None:
        grads = self.xyz_gradient_accum / self.denom
        self.densify_and_clone(grads.nan_to_num(), max_grad, extent)
        masks = (torch.sigmoid(logits).squeeze(-1) < min_opacity for logits in (self._opacity, self._opacity_motion))
        self.prune_points(*masks)

    def extract_dynamic_points_from_static(self, share: float = 0.1) -> None:
        """Appends to the second table by itself, then prunes the first."""
        drift = self._xyz_disp.norm(dim=-1)
        moving = (drift > torch.quantile(drift, 1 - share)) & (self.xyz_error_min_timestamp.squeeze(1) >= 0)
        count = int(moving.sum())
        center = torch.tensor([[0.0], [1.0]]).repeat(count, 1, 1)
        self.cat_tensors_to_optimizer({
            "motion_xyz": torch.stack([self._xyz, self._xyz + self._xyz_disp], 1)[moving],
            "motion_f_dc": self._features_dc[moving],
            "motion_f_rest": self._features_rest[moving],
            "motion_scaling": self._scaling[moving],
            "motion_opacity": self._opacity[moving],
            "motion_opacity_center": center,
            "motion_opacity_var": torch.zeros(count, 2, 1),
            "motion_rotation": self._rotation[moving].unsqueeze(1).repeat(1, 2, 1),
        })  # fmt: skip
        self.prune_points(moving, torch.zeros(len(self._xyz_motion), dtype=torch.bool))

    def mark_error(self, loss: float, timestamp: int) -> None:
        """The best instant of each Gaussian, which selects the dynamic ones."""
        better = self.xyz_error_min > loss
        self.xyz_error_min[better], self.xyz_error_min_timestamp[better] = loss, float(timestamp)

    def prune_nan_points(self) -> None:
        """There are none here."""


class Scene(inria.Scene):
    """Cameras of its N3V reader (dataset_readers.py:291): `image_name` is the FRAME's file, the camera is a folder."""

    def __init__(self, cameras: list[inria.Camera]) -> None:
        for camera in cameras:
            name, frame = camera.image_name.split("_")
            camera.image_name = f"{int(frame)}.png"
            camera.image_path = f"/data/scene/{name}/{camera.image_name}"
        super().__init__(cameras)


def opacity_compensation(means: Tensor, cov: Tensor, camera: inria.Camera, kernel: float) -> Tensor:
    """By automatic differentiation of the projection, guards as in the rasterizer."""
    view = camera.drawn_view()
    R, t = view.T_camera_world[:3, :3], view.T_camera_world[:3, 3]

    def project(x: Tensor) -> Tensor:
        c = R @ x + t
        return torch.stack([view.K[0, 0] * c[0] / c[2], view.K[1, 1] * c[1] / c[2]])

    J = torch.func.vmap(torch.func.jacrev(project))(means)
    full = cov[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    C = J @ full @ J.transpose(1, 2)
    sharp, blurred = torch.linalg.det(C), torch.linalg.det(C + kernel * torch.eye(2))
    return torch.sqrt(sharp.clamp_min(1e-6) / (blurred + 1e-6) + 1e-6)


def render(viewpoint_camera, pc, bg_color, near=0.2) -> dict[str, Tensor]:
    """Depth divided by the accumulated alpha, which is called `acc`."""
    t = viewpoint_camera.timestamp
    means = pc.get_xyz_at_t(t)
    cov = covariances(pc.get_scaling(), pc.get_rotation_at_t(t))
    opacities = pc.get_opacity_at_t(t).squeeze(-1)
    opacities = opacities * opacity_compensation(means, cov, viewpoint_camera, pc.kernel_size)
    projected = torch.cat([means, torch.ones(len(means), 1)], 1) @ viewpoint_camera.full_proj_transform
    inside = (projected[:, :2] / projected[:, 3:]).abs().amax(1) <= 1.3
    rows = torch.nonzero(inside & (projected[:, 3] > near)).squeeze(1)
    splats = Splats(means[rows], cov[rows], opacities[rows], rows)
    settings = RasterSettings(near=near, blur=pc.kernel_size)
    package = draw(splats, pc.rgb[rows], viewpoint_camera, len(means), bg_color, settings)
    acc = package.pop("alpha")
    return package | {"acc": acc, "depth_sum": package["depth"], "depth": package["depth"] / acc.clamp_min(1e-9)}


def make() -> tuple[GaussianModel, Scene]:
    return started(GaussianModel()), Scene(cameras_of(timestamp=lambda view: view.frame))


def training(gaussians: GaussianModel, scene: Scene, opt=None, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    opt = opt or default_options()
    dataset = SimpleNamespace(white_background=False, near=0.2, far=100.0)
    first_iter = inria.set_up(gaussians, opt, checkpoint)

    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    for iteration in range(first_iter + 1, min(opt.iterations, stop) + 1):
        torch.manual_seed(iteration)
        viewpoint_cam = scene.cameras[shuffled(len(scene.cameras), iteration)[0]]
        render_pkg = render(viewpoint_cam, gaussians, bg_color, near=dataset.near)
        loss = l1_loss(render_pkg["render"], viewpoint_cam.original_image)
        loss.backward()

        gaussians.mark_error(loss.item(), viewpoint_cam.timestamp)
        with torch.no_grad():
            static_num = gaussians._xyz.shape[0]
            seen, radii = render_pkg["visibility_filter"][:static_num], render_pkg["radii"][:static_num]
            densify(gaussians, opt, iteration, render_pkg["viewspace_points"].grad[:static_num], seen, radii, 0.01)
            if iteration < opt.densify_until_iter and iteration % 17 == 0:
                gaussians.extract_dynamic_points_from_static()
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)

                gaussians.prune_nan_points()

    return SimpleNamespace(**locals())

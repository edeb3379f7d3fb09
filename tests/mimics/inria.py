"""What the mimics of Inria's descendants share: camera, model with its optimizer surgery, and a render on the CPU."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import torch
from tiny import TinyFrames
from torch import Tensor, nn

from d2_plugin.protocol import View
from d2_plugin.rasterizer import RasterSettings, Splats, rasterize

SH_C0 = 0.28209479177387814
INRIA = RasterSettings()


class Camera:
    """Matrices transposed as in Inria's, intrinsics by fields of view."""

    def __init__(self, view: View, image: Tensor, **extra: object) -> None:
        fx, fy, cx, cy = (float(view.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        self.image_width, self.image_height = view.width, view.height
        self.FoVx, self.FoVy = 2 * math.atan(view.width / (2 * fx)), 2 * math.atan(view.height / (2 * fy))
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1] = 2 * fx / view.width, 2 * fy / view.height
        projection[0, 2], projection[1, 2] = 2 * cx / view.width - 1, 2 * cy / view.height - 1
        projection[2, 2], projection[2, 3], projection[3, 2] = 100 / 99.99, -1 / 99.99, 1.0
        self.world_view_transform = view.T_camera_world.T.clone()
        self.projection_matrix = projection.T.clone()
        self.full_proj_transform = self.world_view_transform @ self.projection_matrix
        self.original_image = image.permute(2, 0, 1).clone()
        self.image_name, self.image_path = f"{view.camera}_{view.frame:04d}", None
        vars(self).update(extra)

    def cuda(self) -> Camera:
        """A deep copy, as fudan's makes each time."""
        return copy.deepcopy(self)

    def drawn_view(self) -> View:
        """What a rasterizer would make of the matrices."""
        P = self.projection_matrix.T
        K = torch.eye(3)
        K[0, 0], K[0, 2] = P[0, 0] * self.image_width / 2, (P[0, 2] + 1) * self.image_width / 2
        K[1, 1], K[1, 2] = P[1, 1] * self.image_height / 2, (P[1, 2] + 1) * self.image_height / 2
        return View("", 0, 0.0, self.world_view_transform.T.contiguous(), K, self.image_width, self.image_height)


def cameras_of(**extra) -> list[Camera]:
    """The six cameras of the tiny scene; each of `extra` is called with the view for an attribute's value."""
    frames = TinyFrames()
    return [
        Camera(view, frames.image(i), **{name: value(view) for name, value in extra.items()})
        for i, view in enumerate(frames.views)
    ]


def default_options(**changed: object) -> SimpleNamespace:
    """Options with the names of arguments/__init__.py, scheduled for a hundred iterations."""
    options = {
        "iterations": 100, "percent_dense": 0.01, "position_lr_init": 2e-3, "densify_from_iter": 10,
        "densify_until_iter": 80, "densification_interval": 13, "densify_grad_threshold": 3e-3, "batch_size": 2,
        "warm_up": 8,
    }  # fmt: skip
    return SimpleNamespace(**(options | changed))


def build_rotation(q: Tensor) -> Tensor:
    """[N, 3, 3] by Inria's formula, which does not care whether q [N, 4] has unit length."""
    r, x, y, z = q.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y),
        2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x),
        2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).view(-1, 3, 3)


def covariances(scales: Tensor, rotations: Tensor) -> Tensor:
    """[N, 6] of R S S R^T."""
    L = build_rotation(rotations) @ torch.diag_embed(scales)
    full = L @ L.transpose(1, 2)
    i, j = torch.triu_indices(3, 3)
    return full[:, i, j]


def draw(
    splats: Splats, colors: Tensor, camera: Camera, count: int, bg_color: list[int], settings: RasterSettings = INRIA
) -> dict[str, Tensor]:
    """A render package of `count` Gaussians, of which those in `splats.rows` are drawn."""
    view = camera.drawn_view()
    points = torch.zeros(count, 3, requires_grad=True)
    half = torch.tensor([view.width / 2, view.height / 2])
    background = torch.tensor(bg_color, dtype=torch.float32)
    offsets = points[splats.rows, :2] * half
    out = rasterize(splats, colors, view, settings, background=background, screen_offsets=offsets)
    with torch.no_grad():
        z = (splats.means @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3])[:, 2]
        size = 3 * splats.covariances[:, [0, 3, 5]].amax(-1).sqrt() * view.K[0, 0] / z
        radii = torch.zeros(count)
        radii[splats.rows] = torch.where(z > 0.2, size.ceil(), torch.zeros_like(size))
    return {
        "render": out.color.permute(2, 0, 1),
        "viewspace_points": points,
        "visibility_filter": radii > 0,
        "radii": radii,
        "depth": out.depth_sum[None],
        "alpha": out.alpha[None],
    }


def draw_all(pc: InriaModel, camera: Camera, bg_color: list[int], means, scales, rotations, opacities) -> dict:
    """The package of every Gaussian, without alpha, as most of the repositories return it."""
    splats = Splats(means, covariances(scales, rotations), opacities.squeeze(-1), torch.arange(len(means)))
    package = draw(splats, pc.rgb, camera, len(means), bg_color)
    del package["alpha"]
    return package


def l1_loss(image: Tensor, truth: Tensor) -> Tensor:
    return (image - truth).abs().mean()


Change = Callable[[Tensor], Tensor]


def swap(optimizer: torch.optim.Adam, group: dict, value: Change, moments: Change) -> nn.Parameter:
    """Put another parameter in a group's place, with what becomes of its values and its moments."""
    old = group["params"][0]
    state = optimizer.state.pop(old, {})
    group["params"][0] = nn.Parameter(value(old.detach()))
    if state:
        changed = {key: moments(state[key]) for key in ("exp_avg", "exp_avg_sq")}
        optimizer.state[group["params"][0]] = state | changed
    return group["params"][0]


class InriaModel:
    """Attributes, named groups and the two structural methods; `columns` are (group, attribute) in postfix order."""

    columns: tuple[tuple[str, str], ...] = (
        ("xyz", "_xyz"),
        ("f_dc", "_features_dc"),
        ("f_rest", "_features_rest"),
        ("opacity", "_opacity"),
        ("scaling", "_scaling"),
        ("rotation", "_rotation"),
    )
    rates: ClassVar[dict[str, float]] = {
        "xyz": 2e-3, "f_dc": 2e-2, "f_rest": 1e-3, "opacity": 5e-2, "scaling": 1e-2, "rotation": 2e-3,
    }  # fmt: skip
    """Of learning; a thousandth for the others."""
    accumulated = ("xyz_gradient_accum", "denom")
    xyz_column, scaling_column = 0, 4

    def __init__(self) -> None:
        self.optimizer, self.percent_dense = None, 0
        self.max_radii2D = torch.empty(0)

    def create_from_pcd(self, points: np.ndarray, colors: np.ndarray, scale: float = 0.15) -> None:
        count = len(points)
        rotation = torch.zeros(count, 4)
        rotation[:, 0] = 1
        self._set("_xyz", torch.tensor(points, dtype=torch.float32))
        self._set("_features_dc", (torch.tensor(colors, dtype=torch.float32)[:, None] - 0.5) / SH_C0)
        self._set("_features_rest", torch.zeros(count, 15, 3))
        self._set("_opacity", torch.logit(torch.full((count, 1), 0.5)))
        self._set("_scaling", torch.full((count, 3), math.log(scale)))
        self._set("_rotation", rotation)
        self.max_radii2D = torch.zeros(count)

    def _set(self, name: str, value: Tensor) -> None:
        setattr(self, name, nn.Parameter(value.requires_grad_(True)))

    @property
    def get_xyz(self) -> Tensor:
        return self._xyz

    @property
    def get_scaling(self) -> Tensor:
        return self._scaling.exp()

    @property
    def get_opacity(self) -> Tensor:
        return torch.sigmoid(self._opacity)

    @property
    def rgb(self) -> Tensor:
        return (0.5 + SH_C0 * self._features_dc[:, 0] + 0 * self._features_rest.sum((1, 2))[:, None]).clamp_min(0)

    def training_setup(self, training_args: SimpleNamespace) -> None:
        self.percent_dense = training_args.percent_dense
        self._zero_accumulators()
        named = ((name, getattr(self, attribute)) for name, attribute in self.columns)
        groups = [{"params": [value], "lr": self.rates.get(name, 1e-3), "name": name} for name, value in named]
        self.optimizer = torch.optim.Adam(groups + self.further_groups(training_args), lr=0.0, eps=1e-15)

    def further_groups(self, opt: SimpleNamespace) -> list[dict[str, object]]:
        return []

    def _zero_accumulators(self) -> None:
        for name in self.accumulated:
            setattr(self, name, torch.zeros(len(self._xyz), 1))

    def _change(self, name: str, value: Change, moments: Change) -> None:
        """What becomes of a column, and of its moments."""
        group = next(group for group in self.optimizer.param_groups if group["name"] == name)
        setattr(self, dict(self.columns)[name], swap(self.optimizer, group, value, moments))

    def prune_points(self, mask: Tensor) -> None:
        keep = ~mask
        for name, _ in self.columns:
            self._change(name, lambda rows: rows[keep], lambda rows: rows[keep])
        for name in (*self.accumulated, "max_radii2D"):
            setattr(self, name, getattr(self, name)[keep])

    def cat_tensors_to_optimizer(self, new: Mapping[str, Tensor]) -> None:
        for name, rows in new.items():
            zeros = torch.zeros_like(rows)
            self._change(name, lambda old: torch.cat([old, rows]), lambda old: torch.cat([old, zeros]))  # noqa: B023

    def densification_postfix(self, *values: Tensor) -> None:
        """Raw rows in the order of `columns`; erases the evidence of every Gaussian, as all these repositories do."""
        assert len(values) == len(self.columns)
        self.cat_tensors_to_optimizer({name: value for (name, _), value in zip(self.columns, values)})
        self._zero_accumulators()
        self.max_radii2D = torch.zeros(len(self._xyz))

    def rows_of(self, mask: Tensor, repeat: int = 1) -> list[Tensor]:
        values = [getattr(self, attribute)[mask] for _, attribute in self.columns]
        return [value.repeat(repeat, *[1] * (value.ndim - 1)) for value in values]

    def densify_and_clone(self, grads: Tensor, threshold: float, extent: float) -> None:
        chosen = (grads.norm(dim=-1) >= threshold) & (self.get_scaling.amax(1) <= self.percent_dense * extent)
        self.densification_postfix(*self.rows_of(chosen))

    def densify_and_split(self, grads: Tensor, threshold: float, extent: float, N: int = 2) -> None:
        padded = torch.zeros(len(self._xyz))
        padded[: len(grads)] = grads.squeeze()
        chosen = (padded >= threshold) & (self.get_scaling.amax(1) > self.percent_dense * extent)
        rows = self.rows_of(chosen, N)
        spread = self.get_scaling[chosen].repeat(N, 1)
        offsets = torch.normal(torch.zeros_like(spread), spread)
        rotation = build_rotation(nn.functional.normalize(self._rotation[chosen])).repeat(N, 1, 1)
        rows[self.xyz_column] = rows[self.xyz_column] + (rotation @ offsets[..., None])[..., 0]
        rows[self.scaling_column] = (spread / (0.8 * N)).log()
        self.densification_postfix(*rows)
        self.prune_points(torch.cat([chosen, torch.zeros(N * int(chosen.sum()), dtype=torch.bool)]))

    def densify_and_prune(self, max_grad: float, min_opacity: float, extent: float, max_screen_size: object) -> None:
        grads = self.xyz_gradient_accum / self.denom
        grads[grads.isnan()] = 0.0
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)
        self.prune_points((self.get_opacity < min_opacity).squeeze())

    def add_densification_stats(self, gradient: Tensor, update_filter: Tensor) -> None:
        self.xyz_gradient_accum[update_filter] += gradient[update_filter, :2].norm(dim=-1, keepdim=True)
        self.denom[update_filter] += 1

    def restore(self, model_args: Mapping[str, object], training_args: SimpleNamespace) -> None:
        """From what `kept` returned; the repositories' checkpoints are tuples, some too small to go on from."""
        restore(self, model_args)


class Scene:
    def __init__(self, cameras: list[Camera]) -> None:
        self.cameras = cameras

    def getTrainCameras(self) -> list[Camera]:
        return self.cameras


def kept(model: object) -> dict[str, object]:
    """What a model needs to go on: tensors, fields and optimizers that belong together, as they are at this moment."""
    values = vars(model) | vars(model).get("_parameters", {})
    own = {name: value for name, value in values.items() if isinstance(value, (Tensor, nn.Module, torch.optim.Adam))}
    copies = copy.deepcopy({name: value for name, value in own.items() if getattr(value, "grad_fn", None) is None})
    for value in copies.values():
        if isinstance(value, nn.Module):
            value._forward_hooks.clear()  # of an adapter
    return copies


def restore(model: object, saved: Mapping[str, object]) -> None:
    for name, value in copy.deepcopy(saved).items():
        setattr(model, name, value)


def set_up(gaussians: InriaModel, opt: SimpleNamespace, checkpoint: tuple[Mapping, int] | None) -> int:
    """Prepare for training, go on from a checkpoint where there is one; returns the iteration that it was made at."""
    gaussians.training_setup(opt)
    model_params, first_iter = checkpoint or ({}, 0)
    gaussians.restore(model_params, opt)
    return first_iter


def densify(gaussians, opt, iteration: int, gradient: Tensor, seen: Tensor, radii: Tensor, faint=0.005) -> None:
    """What all of them do between backward and the optimizer's step, while they densify."""
    if iteration >= opt.densify_until_iter:
        return
    gaussians.max_radii2D[seen] = torch.max(gaussians.max_radii2D[seen], radii[seen])
    gaussians.add_densification_stats(gradient, seen)
    if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
        gaussians.densify_and_prune(opt.densify_grad_threshold, faint, 2.0, None)


def initial_points(count: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points scattered between the cameras and beyond the plane, with colours."""
    random = np.random.default_rng(seed)
    return random.random((count, 3)) * [3.0, 2.0, 3.0] + [-1.5, -1.0, 1.5], random.random((count, 3))


def started(gaussians: InriaModel) -> InriaModel:
    """With those points."""
    gaussians.create_from_pcd(*initial_points())
    return gaussians


def shuffled(count: int, epoch: int) -> list[int]:
    """A new order for every epoch, without the global random state: a resumed run goes on with the same one."""
    return np.random.default_rng(epoch).permutation(count).tolist()

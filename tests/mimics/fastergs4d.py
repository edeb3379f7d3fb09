"""After nerficg-project/faster-gaussian-splatting, FasterGS4D: Yang's model under other names, ordered now and then."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import torch
from tiny import TinyFrames
from torch import Tensor, nn

from d2_plugin.protocol import View
from d2_plugin.rasterizer import RasterSettings, Splats, rasterize

from .inria import SH_C0, Change, initial_points, l1_loss, restore, shuffled, swap

RATES = {
    "spatial_means": 2e-3, "temporal_means": 2e-3, "sh_coefficients_0": 2e-2, "sh_coefficients_rest": 1e-3,
    "opacities": 5e-2, "spatial_scales": 1e-2, "temporal_scales": 1e-2, "left_isoclinic_rotations": 2e-3,
    "right_isoclinic_rotations": 2e-3,
}  # fmt: skip


def build_4d_rotation(left: Tensor, right: Tensor) -> Tensor:
    """[N, 4, 4] on (x, y, z, t): v -> l v r of quaternions v = x + y i + z j + t k."""
    columns = []
    for axis in torch.eye(4):
        columns.append(product(product(nn.functional.normalize(left), axis), nn.functional.normalize(right)))
    return torch.stack(columns, -1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product of quaternions (real part first)."""
    (a0, a1, a2, a3), (b0, b1, b2, b3) = a.unbind(-1), b.unbind(-1)
    return torch.stack([
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    ], -1)  # fmt: skip


class Gaussians(nn.Module):
    """Nine columns, one Adam, densification info [2, N]; `prune` and `sort` are all that change old rows."""

    def __init__(self) -> None:
        super().__init__()
        self.active_sh_degree, self._densification_info, self.optimizer = 0, None, None

    def initialize_from_point_cloud(self, points, colors, min_timestamp: float, max_timestamp: float) -> None:
        count, duration = len(points), max_timestamp - min_timestamp
        identity = torch.zeros(count, 4)
        identity[:, 0] = 1
        values = {
            "spatial_means": torch.tensor(points, dtype=torch.float32),
            "temporal_means": torch.linspace(min_timestamp, max_timestamp, count)[:, None].clone(),
            "sh_coefficients_0": (torch.tensor(colors, dtype=torch.float32)[:, None] - 0.5) / SH_C0,
            "sh_coefficients_rest": torch.zeros(count, 15, 3),
            "opacities": torch.zeros(count, 1),
            "spatial_scales": torch.full((count, 3), math.log(0.15)),
            "temporal_scales": torch.full((count, 1), 0.5 * math.log(0.2 * duration)),
            "left_isoclinic_rotations": identity,
            "right_isoclinic_rotations": identity.clone(),
        }
        for name, value in values.items():
            setattr(self, f"_{name}", nn.Parameter(value))

    def training_setup(self) -> None:
        groups = [{"params": [getattr(self, f"_{name}")], "lr": rate, "name": name} for name, rate in RATES.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)

    def reset_densification_info(self) -> None:
        self._densification_info = torch.zeros(2, len(self._spatial_means))

    def _change(self, value: Change, moments: Change) -> None:
        for group in self.optimizer.param_groups:
            setattr(self, f"_{group['name']}", swap(self.optimizer, group, value, moments))

    def prune(self, prune_mask: Tensor) -> None:
        self._keep(~prune_mask)

    def _keep(self, rows: Tensor) -> None:
        self._change(lambda p: p[rows], lambda m: m[rows])
        if self._densification_info is not None:
            self._densification_info = self._densification_info[:, rows].contiguous()

    def sort(self, ordering: Tensor) -> None:
        self._keep(ordering)

    def adaptive_density_control(self, grad_threshold: float, min_opacity: float) -> None:
        """Copies of small Gaussians at the end, then one prune of what is faint."""
        info = self._densification_info
        chosen = info[1] >= grad_threshold * info[0].clamp_min(1.0)
        self._change(lambda p: torch.cat([p, p[chosen]]), lambda m: torch.cat([m, torch.zeros_like(m[chosen])]))
        self._densification_info = None
        self.prune(self._opacities.flatten() < math.log(min_opacity / (1 - min_opacity)))

    def apply_morton_ordering(self) -> None:
        self.sort(torch.argsort(self._spatial_means.detach()[:, 0]))


class NerficgView:
    """What Datasets/utils.py calls a View."""

    def __init__(self, view, image: Tensor) -> None:
        self.camera = SimpleNamespace(
            width=view.width, height=view.height, focal_x=float(view.K[0, 0]), focal_y=float(view.K[1, 1]),
            center_x=float(view.K[0, 2]), center_y=float(view.K[1, 2]), near_plane=0.2, far_plane=100.0,
        )  # fmt: skip
        self.camera_index, self.timestamp, self.w2c = 0, view.time, view.T_camera_world
        self._rgb = SimpleNamespace(path=Path(f"/data/images/{view.camera}_{view.frame:04d}.png"))
        self.rgb = image.permute(2, 0, 1)


def render_image_training(gaussians: Gaussians, view: NerficgView) -> tuple[Tensor, Tensor]:
    """An image and nothing else; the conditional Gaussian by Schur's complement, as the rasterizer computes it."""
    g, lens = gaussians, view.camera
    R = build_4d_rotation(g._left_isoclinic_rotations, g._right_isoclinic_rotations)
    RS = R * torch.cat([g._spatial_scales, g._temporal_scales], 1).exp()[:, None]
    cov = RS @ RS.transpose(1, 2)
    delta, variance = view.timestamp - g._temporal_means[:, 0], cov[:, 3, 3]
    marginal = torch.exp(-0.5 * delta**2 / variance)
    rows = torch.nonzero(marginal >= 0.05).squeeze(1)
    slope = cov[:, :3, 3] / variance[:, None]
    means = g._spatial_means + slope * delta[:, None]
    spatial = cov[:, :3, :3] - slope[:, :, None] * cov[:, None, :3, 3]
    i, j = torch.triu_indices(3, 3)
    opacities = torch.sigmoid(g._opacities[:, 0]) * marginal
    colors = (0.5 + SH_C0 * g._sh_coefficients_0[:, 0] + 0 * g._sh_coefficients_rest.sum((1, 2))[:, None]).clamp_min(0)
    offsets = torch.zeros(len(rows), 2, requires_grad=True)
    splats = Splats(means[rows], spatial[:, i, j][rows], opacities[rows], rows)
    settings = RasterSettings(near=lens.near_plane, alpha_max=1 - 1e-6)
    out = rasterize(splats, colors[rows], drawn_view(view), settings, screen_offsets=offsets)
    return out.color.permute(2, 0, 1), (rows, offsets, out)


def drawn_view(view: NerficgView) -> View:
    lens = view.camera
    K = torch.tensor([[lens.focal_x, 0, lens.center_x], [0, lens.focal_y, lens.center_y], [0, 0, 1]])
    return View("", 0, view.timestamp, view.w2c, K, lens.width, lens.height)


def make() -> tuple[Gaussians, list[NerficgView]]:
    frames = TinyFrames()
    return Gaussians(), [NerficgView(view, frames.image(i)) for i, view in enumerate(frames.views)]


class Trainer:
    """The callbacks that matter, in the order of their priorities."""

    BATCH_SIZE = 2
    NUM_ITERATIONS = 100

    def __init__(self, gaussians: Gaussians, dataset: list[NerficgView]) -> None:
        self.model, self.dataset = SimpleNamespace(gaussians=gaussians), dataset

    def setup_gaussians(self, saved: dict | None) -> None:
        """As many Gaussians as there were, before anything attaches; the repository pickles the trainer as a whole."""
        points, colors = initial_points()
        self.model.gaussians.initialize_from_point_cloud(points, colors, 0.0, 0.5)
        restore(self.model.gaussians, saved or {})
        if not saved:
            self.model.gaussians.training_setup()
        self.model.gaussians.reset_densification_info()

    def training_iteration(self, iteration: int) -> None:
        order = shuffled(len(self.dataset), iteration + 1)
        new_densification_info = torch.zeros_like(self.model.gaussians._densification_info)
        for _ in range(self.BATCH_SIZE):
            view = self.dataset[order[_]]
            image, (rows, offsets, _out) = render_image_training(self.model.gaussians, view)
            rgb_gt = view.rgb
            loss = l1_loss(image, rgb_gt) / self.BATCH_SIZE
            # backward
            loss.backward()
            new_densification_info[0, rows] += 1
            new_densification_info[1, rows] += 16 * offsets.grad.norm(dim=-1)
        self.model.gaussians._densification_info += new_densification_info

        # optimizer step
        self.model.gaussians.optimizer.step()
        self.model.gaussians.optimizer.zero_grad()

    @torch.no_grad()
    def before(self, iteration: int) -> None:
        """Densification and ordering come before the step of their iteration."""
        gaussians = self.model.gaussians
        if 10 < iteration < 80 and iteration % 13 == 0:
            gaussians.adaptive_density_control(3e-3, 0.005)
            gaussians.reset_densification_info()
        if iteration and iteration % 15 == 0:
            gaussians.apply_morton_ordering()


def training(gaussians: Gaussians, dataset, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    trainer = Trainer(gaussians, dataset)
    saved, first = checkpoint or (None, 0)
    trainer.setup_gaussians(saved)
    restore(gaussians, saved or {})
    for iteration in range(first, min(Trainer.NUM_ITERATIONS, stop)):
        trainer.before(iteration)
        trainer.training_iteration(iteration)
    return SimpleNamespace(gaussians=gaussians, trainer=trainer, d2=getattr(trainer, "d2", None))

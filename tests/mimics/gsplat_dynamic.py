"""After gsplat's dynamic_surgical_trainer.py: planes and a network deform the marked rows of a dict."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from tiny import TinyFrames
from torch import Tensor, nn

from d2_plugin.protocol import View
from d2_plugin.rasterizer import RasterSettings, Splats, rasterize

from . import gsplat
from .inria import covariances, initial_points, l1_loss, shuffled

RATES = {"means": 2e-3, "quats": 2e-3, "scales": 1e-2, "opacities": 5e-2, "colors": 1e-2}


class HexPlaneField(nn.Module):
    """Stands for the planes: features of (x, y, z, t), [N, 6]."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.encoding = nn.Linear(4, 6)

    def forward(self, xyzt: Tensor) -> Tensor:
        return torch.tanh(self.encoding(xyzt))


class DeformNetwork(nn.Module):
    """Three heads; the repository's start at zero, these do not, so that something moves from the first step on."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(8)
            self.pos_head, self.quat_head, self.opacity_head = (nn.Linear(6, n) for n in (3, 4, 1))

    def forward(self, means, quats, opacities, t, plane_features) -> tuple[Tensor, Tensor, Tensor]:
        assert len(means) == len(quats) == len(opacities) == len(plane_features)
        heads = (self.pos_head, self.quat_head, self.opacity_head)
        d_means, d_quats, d_opacities = (0.1 * head(plane_features) for head in heads)
        return means + d_means, quats + d_quats, opacities + d_opacities


class DynamicStrategy(gsplat.DefaultStrategy):
    """The default one, and a mark per Gaussian in its state, which every operation carries along."""

    def initialize_state(self, scene_scale: float = 1.0, num_gaussians: int = 0) -> dict[str, object]:
        marks = torch.arange(num_gaussians) % 3 > 0
        return super().initialize_state(scene_scale) | {"dynamic_mask": marks}

    def step_pre_backward(self, params, optimizers, state, step: int, info) -> None:
        assert info.offsets.requires_grad


def make() -> tuple[nn.ParameterDict, dict[str, torch.optim.Adam], HexPlaneField, DeformNetwork]:
    splats, *_ = gsplat.make()
    params = nn.ParameterDict({name: splats[name] for name in ("means", "quats", "scales")})
    params["opacities"] = nn.Parameter(torch.zeros(len(splats["means"]), 1))
    params["colors"] = nn.Parameter(torch.tensor(initial_points()[1], dtype=torch.float32))
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate) for name, rate in RATES.items()}
    return params, optimizers, HexPlaneField(), DeformNetwork()


def deform_with_mask(params, time: float, mask: Tensor, hexplane, deform_net) -> list[Tensor]:
    """Marked ones gathered, deformed and put back into copies."""
    raw = [params[name] for name in ("means", "quats", "opacities")]
    chosen = torch.where(mask)[0]
    t = torch.full((len(chosen), 1), time)
    parts = [part[chosen] for part in raw]
    moved = deform_net(*parts, t, hexplane(torch.cat([parts[0], t], -1)))
    out = [part.clone() for part in raw]
    for whole, now in zip(out, moved):
        whole[chosen] = now
    return out


def rasterization(params, item, state, hexplane, deform_net) -> tuple[Tensor, dict[str, Tensor]]:
    time = float(item["time"])
    means, quats, logits = deform_with_mask(params, time, state["dynamic_mask"], hexplane, deform_net)
    height, width = item["image"].shape[:2]
    view = View("", 0, time, torch.linalg.inv(item["camtoworld"]), item["K"], width, height)
    offsets = torch.zeros(len(means), 2, requires_grad=True)
    cov = covariances(params["scales"].exp(), nn.functional.normalize(quats))
    splats = Splats(means, cov, torch.sigmoid(logits).squeeze(-1), torch.arange(len(means)))
    settings = RasterSettings(near=0.01)
    out = rasterize(splats, params["colors"].clamp_min(0), view, settings, screen_offsets=offsets)
    return out.color, {"offsets": offsets, "depth_sum": out.depth_sum}


class TwoStageScheduler:
    def __init__(self, coarse_steps: int, fine_steps: int) -> None:
        self.steps = range(coarse_steps, fine_steps)


def items() -> list[dict[str, Tensor]]:
    """What EndoNeRFDataset returns, of the middle camera alone: it has one camera, and time = frame / frames."""
    frames = TinyFrames()
    return [
        {
            "image": frames.image(i), "camtoworld": torch.linalg.inv(view.T_camera_world), "K": view.K,
            "time": torch.tensor(view.frame / 2),
        }
        for i, view in enumerate(frames.views)
        if view.camera == "cam1"
    ]  # fmt: skip


def train_step(item, params, optimizers, hexplane, deform_net, hex_optimizer, strategy, state, step) -> dict:
    image, info = rasterization(params, item, state, hexplane, deform_net)
    loss = l1_loss(image, item["image"])

    info_with_dims = dict(info)
    info = SimpleNamespace(**info_with_dims)
    strategy.step_pre_backward(params, optimizers, state, step, info)
    for opt in optimizers.values():
        opt.zero_grad(set_to_none=True)
    hex_optimizer.zero_grad(set_to_none=True)
    loss.backward()
    for opt in optimizers.values():
        opt.step()
    hex_optimizer.step()
    with torch.no_grad():
        strategy.step_post_backward(params, optimizers, state, step, info)

    return {
        "loss": float(loss.detach().item()),
    }


def training(params, optimizers, hexplane, deform_net, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    dataset, first, parser = items(), 0, SimpleNamespace(times=[0.0, 0.5])
    cfg = SimpleNamespace(coarse_steps=20, fine_steps=80)
    hex_optimizer = torch.optim.Adam([*hexplane.parameters(), *deform_net.parameters()], lr=1e-3)
    strategy = DynamicStrategy()
    state = strategy.initialize_state(scene_scale=1.0, num_gaussians=len(params["means"]))
    if checkpoint:
        (params, optimizers, state, hexplane, deform_net, hex_optimizer), first = checkpoint

    scheduler = TwoStageScheduler(
        coarse_steps=first,
        fine_steps=min(100, stop),
    )
    for step in scheduler.steps:
        torch.manual_seed(step)
        item = dataset[shuffled(len(dataset), step)[0]]
        train_step(item, params, optimizers, hexplane, deform_net, hex_optimizer, strategy, state, step)
    return SimpleNamespace(**locals(), d2=getattr(strategy, "d2", None))

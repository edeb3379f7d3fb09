"""After gsplat's simple_trainer: a dict of parameters, an Adam each, and the operations of its strategies."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace

import torch
from tiny import TinyFrames
from torch import Tensor, nn

from d2_plugin.rasterizer import Splats, rasterize

from .inria import SH_C0, covariances, initial_points, l1_loss, shuffled, swap

RATES = {"means": 2e-3, "scales": 1e-2, "quats": 2e-3, "opacities": 5e-2, "sh0": 2e-2, "shN": 1e-3}


def make() -> tuple[nn.ParameterDict, dict[str, torch.optim.Adam], DefaultStrategy]:
    points, colors = (torch.tensor(values, dtype=torch.float32) for values in initial_points())
    count = len(points)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    splats = nn.ParameterDict({
        "means": nn.Parameter(points),
        "scales": nn.Parameter(torch.full((count, 3), math.log(0.15))),
        "quats": nn.Parameter(quats),
        "opacities": nn.Parameter(torch.zeros(count)),
        "sh0": nn.Parameter((colors[:, None] - 0.5) / SH_C0),
        "shN": nn.Parameter(torch.zeros(count, 15, 3)),
    })  # fmt: skip
    optimizers = {name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
                  for name, rate in RATES.items()}  # fmt: skip
    return splats, optimizers, DefaultStrategy()


def change(splats, optimizers, state, parameter_fn, moment_fn, state_fn) -> None:
    """Every parameter, its moments, and every statistic of the strategy."""
    for name, optimizer in optimizers.items():
        changed = partial(parameter_fn, name)
        splats[name] = swap(optimizer, optimizer.param_groups[0], changed, moment_fn)
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = state_fn(value)


def longer(value: Tensor, count: int) -> Tensor:
    return torch.cat([value, value.new_zeros(count, *value.shape[1:])])


def duplicate(splats, optimizers, state, mask: Tensor) -> None:
    sel = torch.where(mask)[0]
    copied = lambda v: torch.cat([v, v[sel]])  # noqa: E731
    change(splats, optimizers, state, lambda _, p: copied(p), lambda v: longer(v, len(sel)), copied)


def split(splats, optimizers, state, mask: Tensor) -> None:
    sel, rest = torch.where(mask)[0], torch.where(~mask)[0]
    spread = splats["scales"].detach().exp()[sel]

    def halves(name: str, p: Tensor) -> Tensor:
        children = twice(p)
        if name == "means":
            children = children + torch.randn(2, len(sel), 3).mul(spread).reshape(-1, 3)
        if name == "scales":
            children = (spread / 1.6).log().repeat(2, 1)
        return torch.cat([p[rest], children])

    def twice(value: Tensor) -> Tensor:
        return value[sel].repeat([2] + [1] * (value.dim() - 1))

    kept = lambda v: torch.cat([v[rest], twice(v)])  # noqa: E731
    change(splats, optimizers, state, halves, lambda v: longer(v[rest], 2 * len(sel)), kept)


def remove(splats, optimizers, state, mask: Tensor) -> None:
    keep = torch.where(~mask)[0]
    change(splats, optimizers, state, lambda name, p: p[keep], lambda v: v[keep], lambda v: v[keep])


def sample_add(splats, optimizers, state, count: int) -> None:
    """MCMC's way to grow: copies at the end, whose state is zero."""
    grown = lambda v: longer(v, count)  # noqa: E731
    change(splats, optimizers, state, lambda name, p: torch.cat([p, p[:count]]), grown, grown)


def relocate(splats, optimizers, state, mask: Tensor) -> None:
    """MCMC's way to reuse dead Gaussians: they become copies of living ones; the state of those is zeroed."""
    dead = torch.where(mask)[0]
    living = torch.where(~mask)[0][: len(dead)]

    def moved(name: str, p: Tensor) -> Tensor:
        p = p.clone()
        p[dead] = p[living]
        return p

    change(splats, optimizers, state, moved, lambda v: v, lambda v: v.index_fill_(0, living, 0))


def render(splats, view) -> SimpleNamespace:
    p = splats
    rows = torch.arange(len(p["means"]))
    cov = covariances(p["scales"].exp(), nn.functional.normalize(p["quats"]))
    colors = (0.5 + SH_C0 * p["sh0"][:, 0] + 0 * p["shN"].sum((1, 2))[:, None]).clamp_min(0)
    offsets = torch.zeros(len(rows), 2, requires_grad=True)
    sliced = Splats(p["means"], cov, torch.sigmoid(p["opacities"]), rows)
    out = rasterize(sliced, colors, view, screen_offsets=offsets)
    return SimpleNamespace(image=out.color, depth_sum=out.depth_sum, offsets=offsets)


class DefaultStrategy:
    """Gradients on screen decide on duplicates and splits, opacities on removal."""

    def check_sanity(self, params, optimizers) -> None:
        assert set(params) == set(optimizers)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, object]:
        return {"grad2d": None, "count": None, "scene_scale": scene_scale}

    def step_post_backward(self, params, optimizers, state, step: int, info: SimpleNamespace) -> None:
        norm = info.offsets.grad.norm(dim=-1) * 16
        for key, value in (("grad2d", norm), ("count", (norm > 0).float())):
            state[key] = value.clone() if state[key] is None else state[key] + value
        if step % 13 == 0 and 10 < step < 80:
            self.refine(params, optimizers, state)

    def refine(self, params, optimizers, state) -> None:
        grads = state["grad2d"] / state["count"].clamp_min(1)
        large = params["scales"].detach().exp().amax(1) > 0.12
        small = (grads > 1e-3) & ~large
        duplicate(params, optimizers, state, small)
        chosen = torch.cat([(grads > 1e-3) & large, torch.zeros(int(small.sum()), dtype=torch.bool)])
        split(params, optimizers, state, chosen)
        remove(params, optimizers, state, torch.sigmoid(params["opacities"].detach()) < 0.005)
        state["grad2d"].zero_()
        state["count"].zero_()


def training(splats, optimizers, strategy, checkpoint=None, stop: int = 10**9) -> SimpleNamespace:
    init_step, frames = 0, TinyFrames()
    strategy_state = strategy.initialize_state(scene_scale=2.0)
    if checkpoint:
        (splats, optimizers, strategy_state), init_step = checkpoint
    strategy.check_sanity(splats, optimizers)
    for step in range(init_step + 1, min(100, stop) + 1):
        torch.manual_seed(step)
        index = shuffled(len(frames.views), step)[0]
        view = frames.views[index]
        info = render(splats, view)
        loss = l1_loss(info.image, frames.image(index))
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            strategy.step_post_backward(splats, optimizers, strategy_state, step, info)
    return SimpleNamespace(**locals())

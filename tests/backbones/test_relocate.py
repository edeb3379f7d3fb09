"""Relocation: nothing dead is left, the image stays, whoever follows the rows is told, and a resume is bitwise."""

from __future__ import annotations

import io
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import ALL_HOOKS, BACKBONES, is_finite, make_adapter, make_model, make_trainer, make_views, parameters, same

from d2_plugin.backbones.densify import DensifySettings, densify
from d2_plugin.backbones.relocate import MOST_COPIES, relocate, shared_opacity_and_scale, wander

RELOCATING = DensifySettings(method="relocate", start=0.1, stop=0.9, every=7, growth=0.1, budget=90, opacity=0.3)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def published_factor(new: float, old: float, count: int) -> float:
    """Equation 9 of the paper as it stands there, with its double sum."""
    total = sum(
        math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )
    return old / total


@given(opacity=st.floats(0.01, 0.98), count=st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_opacity_and_scale_are_those_of_the_paper(opacity: float, count: int) -> None:
    new, factor = shared_opacity_and_scale(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert 1 - (1 - new.item()) ** count == pytest.approx(opacity, rel=1e-6)
    assert factor.item() == pytest.approx(published_factor(new.item(), opacity, count), rel=1e-6)


@pytest.mark.parametrize("count", [1, 2, 5, MOST_COPIES])
def test_what_a_ray_across_the_gaussian_loses_stays_the_same(count: int) -> None:
    """What the formula is for: along a line the copies together absorb as much as the one Gaussian did."""
    x = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    new, factor = shared_opacity_and_scale(torch.tensor([0.7], dtype=torch.float64), torch.tensor([count]))
    before = (0.7 * torch.exp(-(x**2) / 2)).sum()
    after = (1 - (1 - new * torch.exp(-((x / factor) ** 2) / 2)) ** count).sum()
    assert after.item() == pytest.approx(before.item(), rel=1e-6)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_dead_are_gone_and_reported_as_new_rows(backbone: str) -> None:
    model = make_model(40, backbone=backbone)
    with torch.no_grad():
        model.gaussians["opacity_logits"][:5] = -9
    before = model.gaussians["positions"].detach().clone()
    rows = [torch.arange(40)]
    make_adapter(model).on_resize(lambda index: rows.append(torch.cat([rows[-1], torch.tensor([-1])])[index]))
    dead = torch.sigmoid(model.gaussians["opacity_logits"].detach()) < 0.005
    relocate(model, dead, 3, generator())
    assert len(model) == 43
    assert rows[-1].tolist() == [*range(5, 40), *[-1] * 8]
    assert torch.equal(model.gaussians["positions"][:35], before[5:])
    copies = model.gaussians["positions"][35:, None] == before[None, 5:]
    assert copies.all(-1).any(1).all(), "a copy starts where its source is"


def test_a_image_is_nearly_what_it_was() -> None:
    """One view changes by less than a clone, which doubles what was there, would change it."""
    model, cloned = (make_model(40, temporal=False) for _ in range(2))
    view, nobody = make_views()[0], torch.zeros(40, dtype=torch.bool)
    with torch.no_grad():
        before = model.render(view).color
        relocate(model, nobody, 12, generator())
        cloned.append({name: value.detach()[:12] for name, value in cloned.gaussians.parameters.items()})
        moved, doubled = ((m.render(view).color - before).abs().mean() for m in (model, cloned))
    assert moved < 0.5 * doubled


def test_only_the_faint_wander() -> None:
    model = make_model(40)
    with torch.no_grad():
        model.gaussians["opacity_logits"][:5] = -9
    before = model.gaussians["positions"].detach().clone()
    wander(model, 0.5, generator())
    moved = (model.gaussians["positions"] - before).detach().norm(dim=-1) > 0
    assert moved.tolist() == [True] * 5 + [False] * 35


def test_growth_ends_at_the_budget_and_without_anybody_nothing_happens() -> None:
    model = make_model(40)
    densify(model, DensifySettings(method="relocate", every=1, growth=1.0, budget=55), 10, 100, generator())
    assert len(model) == 55
    empty = make_model(0)
    densify(empty, RELOCATING, 7, 30, generator())
    assert len(empty) == 0


@pytest.mark.parametrize("hooks", [True, False], ids=["all hooks", "no hooks"])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(backbone: str, hooks: bool) -> None:
    config, chosen = ALL_HOOKS if hooks else None, {"densify": RELOCATING, "opacity_weight": 0.01, "scale_weight": 0.1}
    whole, first = (make_trainer(config, backbone=backbone, **chosen) for _ in range(2))
    whole.run()
    first.run(until=17)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = make_trainer(config, backbone=backbone, seed=99, **chosen)
    second.load_state_dict(torch.load(buffer, weights_only=True))
    second.run()
    assert same(parameters(whole), parameters(second))
    assert is_finite(whole)


@pytest.mark.parametrize("weight", ["opacity_weight", "scale_weight"])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_regularization_lowers_what_it_weighs(backbone: str, weight: str) -> None:
    plain, weighed = make_trainer(backbone=backbone), make_trainer(backbone=backbone, **{weight: 1.0})
    name, activate = {
        "opacity_weight": ("opacity_logits", torch.sigmoid),
        "scale_weight": ("log_scales", torch.exp),
    }[weight]
    means = []
    for trainer in (plain, weighed):
        trainer.run(until=6)  # before the first edit
        means.append(activate(trainer.model.gaussians[name].detach()).mean().item())
    assert means[1] < means[0]

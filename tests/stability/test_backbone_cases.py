"""Cases 25 to 36 of the stiff ones: a training step with hooks where a mask is empty or a number leaves its range."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tiny import (
    BACKBONES,
    DISTANCE,
    HEIGHT,
    WIDTH,
    TinyFrames,
    TinyStore,
    make_adapter,
    make_model,
    make_views,
)

from d2_plugin import D2Config, D2Hooks
from d2_plugin.backbones.model import SplatModel
from d2_plugin.config import DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.hooks.depth_loss import charbonnier
from d2_plugin.protocol import DepthPrior, Label

DEPTH_LOSS = D2Config(depth_loss=DepthLossConfig(start=1, every=1))


@pytest.fixture(params=BACKBONES)
def model(request: pytest.FixtureRequest) -> SplatModel:
    """A model of each kind, past its warm-up, whose field, where it has one, moves things."""
    model = make_model(backbone=request.param)
    if getattr(model, "field", None) is not None:
        model.deforms = True
        with torch.no_grad():
            for parameter in model.field.heads.parameters():
                parameter.uniform_(-0.02, 0.02, generator=torch.Generator().manual_seed(1))
    return model


class Store:
    """A prior made by a function of the exact depth and the labels of `TinyStore`."""

    def __init__(self, change: Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]) -> None:
        self.change = change

    def prior(self, camera: str, frame: int) -> DepthPrior:
        """The changed prior of any view."""
        exact = TinyStore().prior(camera, frame)
        depth, labels = self.change(exact.depth.clone(), exact.labels.clone())
        return DepthPrior(depth, labels, exact.colors)


def unlabelled(label: Label, distance: float = DISTANCE) -> Store:
    """One depth, by default the exact one, every pixel labelled alike."""
    return Store(lambda depth, labels: (torch.full_like(depth, distance), torch.full_like(labels, int(label))))


def with_bad_pixels(bad: float) -> Store:
    """Everything verified, a quarter of the depths replaced."""

    def change(depth: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        depth = torch.full_like(depth, DISTANCE)
        depth[: HEIGHT // 2, : WIDTH // 2] = bad
        return depth, torch.full_like(labels, int(Label.VERIFIED))

    return Store(change)


def gradients(model: SplatModel) -> dict[str, torch.Tensor]:
    named = dict(model.gaussians.parameters)
    if getattr(model, "field", None) is not None:
        named |= dict(model.field.named_parameters())
    return {name: p.grad for name, p in named.items() if p.grad is not None}


def step(model: SplatModel, view_index: int = 0, time: float | None = None) -> torch.Tensor:
    """The image loss of one view, differentiated, and one optimizer step; everything must stay finite."""
    frames = TinyFrames()
    view = frames.views[view_index] if time is None else replace(frames.views[view_index], time=time)
    loss = photometric_loss(model.render(view).color, frames.image(view_index))
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(gradient).all() for gradient in gradients(model).values())
    model.accumulate(view)
    model.optimize(1, 100)
    assert_finite(model)
    return loss


def assert_finite(model: SplatModel) -> None:
    for name, parameter in model.gaussians.parameters.items():
        assert torch.isfinite(parameter).all(), name


TRUSTED = (Label.VERIFIED, Label.AGREED)


@pytest.mark.parametrize("label", [label for label in Label if label not in (*TRUSTED, Label.FAR)])
def test_case_25_without_a_trusted_pixel_there_is_no_depth_loss(model: SplatModel, label: Label) -> None:
    d2 = D2Hooks(DEPTH_LOSS, make_adapter(model), unlabelled(label))
    view = make_views()[0]
    model.render(view)
    assert d2.loss(1, view) == 0.0


@pytest.mark.parametrize("label", TRUSTED)
def test_every_trusted_pixel_supervises_and_judges(model: SplatModel, label: Label) -> None:
    """The cases with no such pixel can fail."""
    prune = PruneConfig(start=1, every=1, patience=1, tau_p=0.0)
    config = replace(DEPTH_LOSS, prune=prune, views_per_evaluation=6)
    d2 = D2Hooks(config, make_adapter(model), unlabelled(label))
    for view in make_views():
        model.render(view)
        assert d2.loss(1, view) > 0
    assert d2.step(2).removed > 0


def test_case_25_where_nothing_is_rendered_the_depth_loss_is_zero_with_zero_gradients(model: SplatModel) -> None:
    with torch.no_grad():
        model.gaussians["opacity_logits"].fill_(-8)  # visible, and nowhere alpha > tau_v
    papers = replace(DEPTH_LOSS, depth_loss=replace(DEPTH_LOSS.depth_loss, opaque=0))
    d2 = D2Hooks(papers, make_adapter(model), unlabelled(Label.VERIFIED))
    view = make_views()[0]
    model.render(view)
    loss = d2.loss(1, view)
    loss.backward()
    assert loss.item() == 0
    assert all(not gradient.any() for gradient in gradients(model).values())


@pytest.mark.parametrize("residual", [0.0, 1e-30, 1e-8, 1.0, 1e20, 3e38])
def test_case_26_the_charbonnier_penalty_is_finite_over_the_range_of_float32(residual: float) -> None:
    r = torch.tensor([residual, -residual], requires_grad=True)
    loss = charbonnier(r, 0.01)
    loss.sum().backward()
    exact = residual * (residual / (math.hypot(residual, 0.01) + 0.01))
    torch.testing.assert_close(
        loss.detach().double(), torch.tensor([exact, exact], dtype=torch.float64), rtol=1e-6, atol=1e-45
    )
    slope = residual / math.hypot(residual, 0.01)
    torch.testing.assert_close(r.grad.double(), torch.tensor([slope, -slope], dtype=torch.float64), rtol=1e-6, atol=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 0.0, -1.0])
def test_case_27_bad_pixels_of_a_prior_reach_neither_loss_nor_gradient(model: SplatModel, bad: float) -> None:
    adapter, view = make_adapter(model), make_views()[0]
    losses = []
    for store in (with_bad_pixels(bad), with_bad_pixels(0.0)):
        model.render(view)
        loss = D2Hooks(DEPTH_LOSS, adapter, store).loss(1, view)
        loss.backward()
        assert torch.isfinite(loss)
        assert all(torch.isfinite(gradient).all() for gradient in gradients(model).values())
        losses.append(loss.item())
    assert losses[0] == losses[1] > 0


@pytest.mark.parametrize("offset", [0.0, 1e-6, 0.1, None], ids=["there", "beside", "away", "in deviations"])
@pytest.mark.parametrize("variance", [1e-40, 1e-20, 1e-10, 1e10, 1e20])
def test_case_28_and_29_training_survives_any_temporal_variance(variance: float, offset: float | None) -> None:
    model = make_model()
    with torch.no_grad():
        model.gaussians["log_time_scales"].fill_(0.5 * math.log(variance))
        model.gaussians["times"].fill_(0.3 * math.sqrt(variance) if offset is None else offset)
    step(model, time=0.0)


def test_case_31_a_huge_velocity_is_culled_and_trained(model: SplatModel) -> None:
    """4D Gaussians get it from their axes; a field from its last layer."""
    with torch.no_grad():
        if model.__class__.__name__ == "Deform":
            model.field.heads.bias.fill_(1e12)
        else:
            half = 1e-6 / 2
            model.gaussians["log_scales"][:, 0] = math.log(1e13)
            model.gaussians["left"].copy_(torch.tensor([math.cos(half), 0, 0, math.sin(half)]).expand(60, 4))
            model.gaussians["right"].copy_(torch.tensor([math.cos(half), 0, 0, -math.sin(half)]).expand(60, 4))
    step(model, time=0.5)


@pytest.mark.parametrize("time", [1e9, -1e9, math.inf])
def test_case_32_a_field_rests_outside_of_the_scenes_time(time: float) -> None:
    for backbone in ("mlp", "hexplane"):
        model = make_model(backbone=backbone)
        model.deforms = True
        step(model, time=time)
        end = 0.0 if time < 0 else model.duration
        inside, outside = (model.slice_at(replace(make_views()[0], time=t)) for t in (end, time))
        assert all(torch.equal(a, b) for a, b in zip(inside, outside))


def test_case_33_a_gaussian_that_no_view_sees_is_not_judged(model: SplatModel) -> None:
    """Behind all cameras: O_k has no observation and E_k no evidence; its streak stays where it is."""
    with torch.no_grad():
        model.gaussians["positions"][:10, 2] = -50
    config = D2Config(prune=PruneConfig(start=1, every=1, patience=1, tau_p=0.0), views_per_evaluation=6)
    d2 = D2Hooks(config, make_adapter(model), unlabelled(Label.VERIFIED))
    for view in make_views():
        d2.loss(1, view)
    before = model.gaussians["base_colors"][:10].detach().clone()
    d2.step(2)
    assert len(model) < 60, "the others are judged: tau_p is zero"
    assert torch.equal(model.gaussians["base_colors"][:10].detach(), before)


@pytest.mark.parametrize("label", [label for label in Label if label not in TRUSTED])
def test_case_34_without_trusted_pixels_nothing_is_pruned_whatever_the_threshold(
    model: SplatModel, label: Label
) -> None:
    config = D2Config(prune=PruneConfig(start=1, every=1, patience=1, tau_p=0.0), views_per_evaluation=6)
    d2 = D2Hooks(config, make_adapter(model), unlabelled(label))
    for view in make_views():
        d2.loss(1, view)
    for number in range(2, 6):
        assert d2.step(number).removed == 0
    assert d2.hooks["prune"].streak is None or not d2.hooks["prune"].streak.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_case_36_an_empty_scene_is_filled_within_the_budget_from_depths_that_are_some(
    model: SplatModel, bad: float
) -> None:
    model.select(torch.zeros(0, dtype=torch.int64))
    config = D2Config(
        densify=DensifyConfig(start=1, every=1, budget_per_view=20, max_gaussians=70), views_per_evaluation=6
    )
    d2 = D2Hooks(config, make_adapter(model), with_bad_pixels(bad))
    for view in make_views():
        d2.loss(1, view)
    report = d2.step(2)
    assert 0 < report.inserted <= 70
    assert_finite(model)
    splats = model.slice_at(make_views()[0])
    assert (splats.covariances[:, [0, 3, 5]] > 0).all()
    depths = splats.means[:, 2]
    assert ((depths > 0.5 * DISTANCE) & (depths < 2 * DISTANCE)).all()
    step(model)

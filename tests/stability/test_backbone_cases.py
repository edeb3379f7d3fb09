"""Stiff cases 18 to 41 of depth and of a training step with hooks: empty masks, numbers that leave their range."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny import BACKBONES, DISTANCE, ChangedStore, TinyFrames, bend_field, make_adapter, make_model, make_views

from d2_plugin import D2Config, D2Hooks
from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.starting import nearest_neighbour_scales
from d2_plugin.config import DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.hooks.densify import EPSILON, rendered_depth
from d2_plugin.hooks.depth_loss import charbonnier
from d2_plugin.protocol import DepthPrior, Label

DEPTH_LOSS = D2Config(depth_loss=DepthLossConfig(start=1, every=1))


@pytest.fixture(params=BACKBONES)
def model(request: pytest.FixtureRequest) -> SplatModel:
    """A model of each kind, past its warm-up, whose field, where it has one, moves things."""
    return bend_field(make_model(backbone=request.param))


def unlabelled(label: Label, bad: float = DISTANCE) -> ChangedStore:
    """The exact depth, every pixel labelled alike; a quarter of the depths may be bad."""

    def change(prior: DepthPrior) -> DepthPrior:
        depth = torch.full_like(prior.depth, DISTANCE)
        depth[:12, :16] = bad
        return prior._replace(depth=depth, labels=torch.full_like(prior.labels, int(label)))

    return ChangedStore(change)


def gradients(model: SplatModel) -> dict[str, torch.Tensor]:
    return {name: p.grad for name, p in make_adapter(model).trained().items() if p.grad is not None}


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
    for name, parameter in make_adapter(model).trained().items():
        assert torch.isfinite(parameter).all(), name


@pytest.mark.parametrize("label", Label)
def test_case_25_and_34_trusted_pixels_alone_supervise_and_judge_whatever_the_threshold(model, label) -> None:
    trusted = label in (Label.VERIFIED, Label.AGREED)
    prune = PruneConfig(start=1, every=1, patience=1, tau_p=0.0, sight=False)
    d2 = D2Hooks(replace(DEPTH_LOSS, prune=prune, views_per_evaluation=6), make_adapter(model), unlabelled(label))
    for view in make_views():
        model.render(view)
        loss = d2.loss(1, view)
        if label is not Label.FAR:  # which pulls from the front
            assert (loss > 0) == trusted
    removed = [d2.step(number).removed for number in range(2, 6)]
    assert (removed[0] > 0) == any(removed) == trusted


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
    assert loss.tolist() == pytest.approx([exact, exact], rel=1e-6, abs=1e-45)
    slope = residual / math.hypot(residual, 0.01)
    assert r.grad.tolist() == pytest.approx([slope, -slope], rel=1e-6, abs=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 0.0, -1.0])
def test_case_27_bad_pixels_of_a_prior_reach_neither_loss_nor_gradient(model: SplatModel, bad: float) -> None:
    adapter, view = make_adapter(model), make_views()[0]
    losses = []
    for depth in (bad, 0.0):
        model.render(view)
        loss = D2Hooks(DEPTH_LOSS, adapter, unlabelled(Label.VERIFIED, depth)).loss(1, view)
        loss.backward()
        assert torch.isfinite(loss)
        assert all(torch.isfinite(gradient).all() for gradient in gradients(model).values())
        losses.append(loss.item())
    assert losses[0] == losses[1] > 0


@pytest.mark.parametrize("offset", [0.0, 1e-6, 0.1, None], ids=["there", "beside", "away", "in deviations"])
@pytest.mark.parametrize("variance", [1e-40, 1e-10, 1e20])
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
    model = make_model(backbone="deform")
    step(model, time=time)
    end = 0.0 if time < 0 else model.duration
    with torch.no_grad():  # else the noise of training is added to the time
        inside, outside = (model.slice_at(replace(make_views()[0], time=t)) for t in (end, time))
    assert all(torch.equal(a, b) for a, b in zip(inside, outside))


@pytest.mark.parametrize("sight", [False, True])
def test_case_33_a_gaussian_that_no_view_sees_is_not_judged(model: SplatModel, sight: bool) -> None:
    """Behind all cameras: O_k has no observation and E_k no evidence; its streak stays where it is. It goes unjudged
    where `sight` asks for a camera that sees its centre."""
    with torch.no_grad():
        model.gaussians["positions"][:10, 2] = -50
    prune = PruneConfig(start=1, every=1, patience=1, tau_p=0.0, sight=sight)
    d2 = D2Hooks(D2Config(prune=prune, views_per_evaluation=6), make_adapter(model), unlabelled(Label.VERIFIED))
    for view in make_views():
        d2.loss(1, view)
    before = model.gaussians["base_colors"][:10].detach().clone()
    d2.step(2)
    assert len(model) < 60, "the others are judged: tau_p is zero"
    assert int((model.gaussians["positions"][:, 2] < -49).sum()) == (0 if sight else 10)
    assert sight or torch.equal(model.gaussians["base_colors"][:10].detach(), before)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_case_36_an_empty_scene_is_filled_within_the_budget_from_depths_that_are_some(model, bad) -> None:
    model.select(torch.zeros(0, dtype=torch.int64))
    densify = DensifyConfig(start=1, every=1, budget_per_view=20, max_gaussians=70)
    d2 = D2Hooks(
        D2Config(densify=densify, views_per_evaluation=6), make_adapter(model), unlabelled(Label.VERIFIED, bad)
    )
    for view in make_views():
        d2.loss(1, view)
    assert 0 < d2.step(2).inserted <= 70
    assert_finite(model)
    splats = model.slice_at(make_views()[0])
    assert (splats.covariances[:, [0, 3, 5]] > 0).all()
    depths = splats.means[:, 2]
    assert ((depths > 0.5 * DISTANCE) & (depths < 2 * DISTANCE)).all()
    step(model)


TAU_V = 0.5
both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


@both
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_case_19_few_points_start_with_a_finite_scale_whether_apart_or_in_one_place(count: int, dtype) -> None:
    apart = nearest_neighbour_scales(torch.eye(4, 3, dtype=dtype)[:count])
    together = nearest_neighbour_scales(torch.ones(count, 3, dtype=dtype))
    for scales in (apart, together):
        assert scales.shape == (count,)
        assert scales.isfinite().all()
        assert ((scales >= 1e-7) & (scales < 10)).all()


@both
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_case_19_points_close_together_far_from_the_origin_start_as_wide_as_near_it(offset: float, dtype) -> None:
    """A matrix product in place of differences loses them there: a hundred-thousandth as wide, in float32."""
    side = torch.arange(10, dtype=dtype) / 128
    scales = nearest_neighbour_scales(torch.cartesian_prod(side, side, side) + offset)
    torch.testing.assert_close(scales, torch.full_like(scales, 1 / 128))


@both
def test_case_21_within_one_ulp_of_tau_v_the_mask_flips_and_gradients_stay_below_the_spread_over_tau_v(dtype) -> None:
    threshold = torch.tensor(TAU_V, dtype=dtype)
    sides = torch.stack([torch.nextafter(threshold, threshold * s) for s in (0, 2)])[None]
    alpha = sides.clone().requires_grad_()
    near, far = 2.0, 5.0  # half of the weight at each
    depth_sum = (sides * (near + far) / 2).requires_grad_()
    depth, valid = rendered_depth(depth_sum, alpha, TAU_V)
    assert valid.tolist() == [[False, True]]
    by_sum, by_alpha = torch.autograd.grad(depth.sum(), (depth_sum, alpha))
    for z in (near, far):  # d D / d w of a Gaussian at depth z
        assert (by_sum * z + by_alpha).abs().max() <= (far - near) / TAU_V
    assert torch.equal(by_sum[0, :1], torch.zeros(1, dtype=dtype))


@both
@pytest.mark.parametrize("alpha", [1e-8, 1e-6, 1e-4])
def test_case_22_a_vanishing_alpha_is_masked_and_epsilon_alone_biases_depth_by_its_share(alpha: float, dtype) -> None:
    maps = torch.tensor([[4 * alpha]], dtype=dtype), torch.tensor([[alpha]], dtype=dtype)
    assert rendered_depth(*maps, TAU_V)[0].item() == 0
    unmasked, _ = rendered_depth(*maps, 0.0)
    assert unmasked.item() == pytest.approx(4 * (1 - EPSILON / (alpha + EPSILON)), rel=1e-5)


@given(
    layers=st.lists(st.tuples(st.floats(1e-3, 1e6), st.floats(1e-6, 1)), min_size=1, max_size=20),
    tau_v=st.floats(1e-3, 0.9),
)
def test_case_41_rendered_depth_lies_between_its_nearest_and_its_farthest_gaussian(layers: list, tau_v: float) -> None:
    depths, weights = torch.tensor(layers, dtype=torch.float64).unbind(1)
    weights = weights / max(weights.sum().item(), 1)  # A(p) <= 1
    depth, valid = rendered_depth((weights * depths).sum()[None], weights.sum()[None], tau_v)
    if valid:
        assert depths.min() * (1 - 2 * EPSILON / tau_v) <= depth <= depths.max() * (1 + 1e-12)
    else:
        assert depth == 0

"""What the rasterizer knows of the prior: the weight in space that must be free, and how much each pixel counts.

front(p) = sum_i w_i max(0, 1 - z_i / D_near(p)); the paths are held against the definition and against each other.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from splat_scenes import (
    Scene,
    brute_force,
    brute_force_front,
    near_edge_of,
    random_scene,
    single,
)

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Label
from d2_plugin.rasterizer import DepthPrior, survey

both_paths = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


def everywhere(scene: Scene, value: float) -> torch.Tensor:
    return torch.full((scene.view.height, scene.view.width), value, dtype=torch.float64)


def prior_with(scene: Scene, label: Label = Label.VERIFIED, depth: float = 3.0, **maps: torch.Tensor) -> DepthPrior:
    size = (scene.view.height, scene.view.width)
    return DepthPrior(torch.full(size, depth), torch.full(size, label, dtype=torch.uint8), **maps)


# ---------------------------------------------------------------- the definition


@pytest.mark.parametrize("seed", range(3))
def test_front_is_the_sum_of_the_definition(seed):
    scene = random_scene(seed, 150, 37, 41)
    edge = near_edge_of(scene.view, seed)
    expected = brute_force_front(brute_force(scene), edge)
    np.testing.assert_allclose(scene.render(near_edge=edge).front.numpy(), expected.sum(0), atol=1e-12)
    prior = prior_with(scene)
    front = survey(scene.splats, scene.view, prior, near_edge=edge).front
    np.testing.assert_allclose(front.numpy(), expected.sum((1, 2)), atol=1e-11)
    assert expected.sum() > 1, "some stand in free space"


def test_front_of_one_gaussian_falls_linearly_with_its_depth_to_nothing_at_the_edge():
    for depth, share in ((1.0, 0.75), (2.0, 0.5), (4.0, 0.0), (5.0, 0.0)):
        scene = single(depth=depth, opacity=0.5)
        front = scene.render(near_edge=everywhere(scene, 4.0)).front
        assert front[7, 7].item() == pytest.approx(0.5 * share, abs=1e-12)


# ---------------------------------------------------------------- the edge itself


@both_paths
@pytest.mark.parametrize("depth", [0.3, 3.7, 1e3])
def test_at_the_edge_front_and_its_gradients_are_exactly_zero(dtype, depth):
    """Also where 1 / D_near is not exact: 1 - z / D_near by a multiplication would leave a rounding error."""
    scene = single(depth=depth, opacity=0.5, variance=0.01 * depth**2, dtype=dtype).requires_grad()
    front = scene.render(near_edge=everywhere(scene, scene.means[0, 2].item())).front
    assert not front.any()
    assert not any(part.any() for part in torch.autograd.grad(front.sum(), scene[:3]))


@both_paths
def test_a_hair_before_the_edge_front_keeps_its_digits(dtype):
    scene = single(depth=4.0, opacity=0.5, dtype=dtype)
    edge = np.nextafter(np.float32(4), np.float32(5))
    front = scene.render(near_edge=everywhere(scene, float(edge))).front[7, 7].item()
    assert front == pytest.approx(0.5 * (float(edge) - 4) / float(edge), rel=1e-5)


# ---------------------------------------------------------------- stiff cases


@both_paths
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, -math.inf, 1e-40, 1e-30])
def test_where_nothing_is_known_front_is_zero_without_gradient(dtype, value):
    scene = random_scene(3, 40, 20, 20).to(dtype).requires_grad()
    edge = everywhere(scene, value)
    render = scene.render(near_edge=edge)
    assert render.front.shape == (20, 20)
    assert not render.front.any()
    assert not any(part.any() for part in torch.autograd.grad(render.front.sum(), scene[:3]))
    assert not survey(scene.to(dtype).splats, scene.view, prior_with(scene), near_edge=edge).front.any()


@both_paths
def test_a_loss_that_sends_nan_where_nothing_is_known_spoils_no_gradient(dtype):
    scene = random_scene(3, 40, 20, 20).to(dtype).requires_grad()
    edge = near_edge_of(scene.view)
    known = edge.isfinite() & (edge > 1e-30)
    front = scene.render(near_edge=edge).front
    (front / known.to(front))[known].sum().backward()
    for part in scene[:3]:
        assert part.grad.isfinite().all()
        assert part.grad.any()


@both_paths
def test_edges_of_nine_decades_in_one_image(dtype):
    scene = random_scene(4, 200, 40, 30).to(dtype).requires_grad()
    edge = everywhere(scene, 1e-3)
    edge[:, 20:] = 1e6
    render = scene.render(near_edge=edge)
    assert not render.front[:, :20].any(), "nothing is nearer than a millimetre"
    torch.testing.assert_close(render.front[:, 20:], render.alpha[:, 20:], atol=1e-5, rtol=0)
    for part in torch.autograd.grad(render.front.sum(), scene[:3]):
        assert part.isfinite().all()


# ---------------------------------------------------------------- what it must not change


@both_paths
def test_a_near_edge_changes_no_bit_of_anything_else(dtype):
    scene = random_scene(6, 300, 61, 47).to(dtype)
    results = []
    for edge in (None, near_edge_of(scene.view)):
        leaves = scene.requires_grad()
        render = leaves.render(near_edge=edge)
        assert (render.front is None) == (edge is None)
        gradients = torch.autograd.grad(render.color.sum() + render.depth_sum.sin().sum(), leaves[:4])
        statistics = survey(scene.splats, scene.view, prior_with(scene), near_edge=edge)
        results.append([*render[:3], *gradients, *statistics[:6]])
    assert all(torch.equal(part, other) for part, other in zip(*results))


def test_maps_that_do_not_fit_are_named():
    scene = single()
    with pytest.raises(D2Error, match=r"near_edge has shape \(15, 14\), expected \(15, 15\)"):
        scene.render(near_edge=torch.ones(15, 14))
    with pytest.raises(D2Error, match="near_edge is torch.int64, expected floating-point depths"):
        survey(scene.splats, scene.view, prior_with(scene), near_edge=torch.ones(15, 15, dtype=torch.int64))
    with pytest.raises(D2Error, match=r"reliability \(3, 3\) but the view is \(15, 15\): resample it"):
        survey(scene.splats, scene.view, prior_with(scene, reliability=torch.ones(3, 3)))


# ---------------------------------------------------------------- reliability


@both_paths
def test_without_a_map_reliability_is_one_where_the_prior_is_trusted(dtype):
    scene = random_scene(3, 120, 36, 34).to(dtype)
    g = torch.Generator().manual_seed(0)
    labels = torch.randint(0, len(Label), (34, 36), generator=g, dtype=torch.uint8)
    prior = DepthPrior(1 + 4 * torch.rand(34, 36, generator=g), labels)
    stated = prior._replace(reliability=prior.trusted.float())
    one, two = (survey(scene.splats, scene.view, which) for which in (prior, stated))
    assert all(torch.equal(part, other) for part, other in zip(one, two))
    half = survey(scene.splats, scene.view, prior._replace(reliability=0.5 * prior.trusted))
    for name in ("weight", "error"):
        torch.testing.assert_close(2 * getattr(half, name), getattr(one, name))
    assert torch.equal(half.hits, one.hits)


@both_paths
def test_far_pixels_judge_no_depth_but_what_stands_in_front_of_them(dtype):
    scene = single(depth=4.0, opacity=0.5, dtype=dtype)
    prior = prior_with(scene, Label.FAR, depth=100.0, reliability=torch.ones(15, 15))
    statistics = survey(scene.splats, scene.view, prior, near_edge=prior.near_edge(3.0))
    assert statistics.weight.item() == statistics.error.item() == statistics.hits.item() == 0
    assert statistics.front.item() == pytest.approx(0.96 * scene.render().alpha.sum().item(), rel=1e-5)


# ---------------------------------------------------------------- the near edge of a prior


def test_near_edge_of_a_prior_is_k_sigmas_before_its_depth():
    sigma = torch.tensor([[0.0, 0.1, 0.5, math.inf, math.nan, -0.1, 0.1, 0.1, 0.1]])
    depth = torch.tensor([[2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 0.0, math.nan, math.inf]])
    prior = DepthPrior(depth, torch.full((1, 9), Label.MONO, dtype=torch.uint8), sigma=sigma)
    torch.testing.assert_close(prior.near_edge(3.0), torch.tensor([[2.0, 1.4, 0, 0, 0, 0, 0, 0, 0]]))


def test_near_edge_of_far_pixels_is_their_depth_whatever_sigma_says():
    prior = DepthPrior(torch.tensor([[50.0, 0.0]]), torch.full((1, 2), Label.FAR, dtype=torch.uint8))
    for sigma in (None, torch.tensor([[math.inf, 0.1]]), torch.tensor([[0.3, math.nan]])):
        assert prior._replace(sigma=sigma).near_edge(2.0).tolist() == [[50.0, 0.0]]


def test_near_edge_without_sigma_is_the_depth_of_trusted_pixels():
    prior = DepthPrior(torch.full((1, len(Label)), 2.0), torch.arange(len(Label), dtype=torch.uint8)[None])
    expected = [2.0 if label in (Label.VERIFIED, Label.AGREED, Label.FAR) else 0.0 for label in Label]
    assert prior.near_edge(3.0).tolist() == [expected]

"""What the rasterizer knows of the prior: the weight in space that must be free, and how much each pixel counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from splat_scenes import Path, Scene, near_edge_of, prior_of, random_scene, single

from d2_plugin.protocol import Label
from d2_plugin.rasterizer import DepthPrior, survey


def everywhere(scene: Scene, value: float) -> torch.Tensor:
    return torch.full(scene.size, value, dtype=torch.float64, device=scene.means.device)


@pytest.mark.parametrize("depth", [0.3, 3.7, 1e3])
def test_at_the_edge_front_and_its_gradients_are_exactly_zero(path: Path, depth: float) -> None:
    """Also where 1 / D_near is not exact: 1 - z / D_near by a multiplication would leave a rounding error."""
    scene = single(depth=depth, opacity=0.5, variance=0.01 * depth**2).on(path).requires_grad()
    front = scene.render(near_edge=everywhere(scene, scene.means[0, 2].item())).front
    assert not front.any()
    assert not any(part.any() for part in torch.autograd.grad(front.sum(), scene[:3]))


def test_a_hair_before_the_edge_front_keeps_its_digits(path: Path) -> None:
    scene = single(depth=4.0, opacity=0.5).on(path)
    edge = float(np.nextafter(np.float32(4), np.float32(5)))
    front = scene.render(near_edge=everywhere(scene, edge)).front[7, 7].item()
    assert front == pytest.approx(0.5 * (edge - 4) / edge, rel=1e-5)


def test_where_nothing_is_known_front_is_zero_without_gradient(path: Path) -> None:
    scene = random_scene(3, 40, 21, 20).on(path).requires_grad()
    edge = torch.tensor([0.0, -1.0, math.nan, math.inf, -math.inf, 1e-40, 1e-30]).repeat(20, 3).to(path.device)
    front = scene.render(near_edge=edge).front
    assert front.shape == (20, 21)
    assert not front.any()
    assert not any(part.any() for part in torch.autograd.grad(front.sum(), scene[:3]))
    assert not survey(scene.splats, scene.view, prior_of(scene.view), near_edge=edge).front.any()


def test_a_loss_that_sends_nan_where_nothing_is_known_spoils_no_gradient(path: Path) -> None:
    scene = random_scene(3, 40, 20, 20).on(path).requires_grad()
    edge = near_edge_of(scene.view)
    known = edge.isfinite() & (edge > 1e-30)
    front = scene.render(near_edge=edge).front
    (front / known.to(front))[known].sum().backward()
    for part in scene[:3]:
        assert part.grad.isfinite().all()
        assert part.grad.any()


def test_edges_of_nine_decades_in_one_image(path: Path) -> None:
    scene = random_scene(4, 200, 40, 30).on(path).requires_grad()
    edge = everywhere(scene, 1e-3)
    edge[:, 20:] = 1e6
    render = scene.render(near_edge=edge)
    assert not render.front[:, :20].any(), "nothing is nearer than a millimetre"
    torch.testing.assert_close(render.front[:, 20:], render.alpha[:, 20:], atol=1e-5, rtol=0)
    assert all(part.isfinite().all() for part in torch.autograd.grad(render.front.sum(), scene[:3]))


def test_a_near_edge_changes_no_bit_of_anything_else(path: Path) -> None:
    scene = random_scene(6, 300, 61, 47).on(path)
    results = []
    for edge in (None, near_edge_of(scene.view)):
        leaves = scene.requires_grad()
        render = leaves.render(near_edge=edge)
        assert (render.front is None) == (edge is None)
        gradients = torch.autograd.grad(render.color.sum() + render.depth_sum.sin().sum(), leaves[:4])
        statistics = survey(scene.splats, scene.view, prior_of(scene.view), near_edge=edge)
        assert statistics.front.any() == (edge is not None)
        results.append([*render[:3], *gradients, *statistics[:6]])
    assert all(torch.equal(part, other) for part, other in zip(*results))


def test_without_a_map_reliability_is_one_where_the_prior_is_trusted(path: Path) -> None:
    scene = random_scene(3, 120, 36, 34).on(path)
    prior = prior_of(scene.view)
    stated = prior._replace(reliability=prior.trusted.float())
    one, two = (survey(scene.splats, scene.view, which) for which in (prior, stated))
    assert all(torch.equal(part, other) for part, other in zip(one, two))
    half = survey(scene.splats, scene.view, prior._replace(reliability=0.5 * prior.trusted))
    for name in ("weight", "error"):
        torch.testing.assert_close(2 * getattr(half, name), getattr(one, name))
    assert torch.equal(half.hits, one.hits)


def test_the_near_edge_of_a_prior_is_k_sigmas_before_its_depth() -> None:
    sigma = torch.tensor([[0.0, 0.1, 0.5, math.inf, math.nan, -0.1, 0.1, 0.1, 0.1]])
    depth = torch.tensor([[2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 0.0, math.nan, math.inf]])
    prior = DepthPrior(depth, torch.full((1, 9), Label.MONO, dtype=torch.uint8), sigma=sigma)
    torch.testing.assert_close(prior.near_edge(3.0), torch.tensor([[2.0, 1.4, 0, 0, 0, 0, 0, 0, 0]]))
    far = DepthPrior(torch.tensor([[50.0, 0.0]]), torch.full((1, 2), Label.FAR, dtype=torch.uint8))
    for sigma in (None, torch.tensor([[math.inf, 0.1]]), torch.tensor([[0.3, math.nan]])):
        assert far._replace(sigma=sigma).near_edge(2.0).tolist() == [[50.0, 0.0]], "the depth itself"
    every = DepthPrior(torch.full((1, len(Label)), 2.0), torch.arange(len(Label), dtype=torch.uint8)[None])
    trusted = [2.0 if label in (Label.VERIFIED, Label.AGREED, Label.FAR) else 0.0 for label in Label]
    assert every.near_edge(3.0).tolist() == [trusted], "without sigma the depth of trusted pixels"

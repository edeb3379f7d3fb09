"""The anti-aliased footprint: what the blur spreads it does not add, on every path and with exact gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from splat_scenes import Scene, brute_force, random_scene, single

from d2_plugin.protocol import DepthPrior, Label, RasterSettings
from d2_plugin.rasterizer import reference, survey

SMOOTH = RasterSettings(antialiased=True)


def small_scene(seed: int, count: int = 120, width: int = 40, height: int = 30) -> Scene:
    """Gaussians of about a third of a pixel, where the blur is most of what is seen."""
    return random_scene(seed, count, width, height, radius=0.7)


@pytest.mark.parametrize("seed", range(3))
def test_image_is_the_compositing_sum_with_the_compensated_opacity(seed):
    scene = small_scene(seed)
    found = brute_force(scene, SMOOTH)
    np.testing.assert_allclose(scene.render(SMOOTH).alpha.numpy(), found.weights.sum(0), atol=1e-12)
    assert (scene.render().alpha - scene.render(SMOOTH).alpha).abs().max() > 0.05


def weight_of_one(variance: float, depth: float, settings: RasterSettings) -> float:
    """Sum of alpha over the image: what one faint Gaussian adds to it."""
    return single(depth=depth, opacity=0.02, variance=variance).render(settings).alpha.sum().item()


def test_what_a_small_gaussian_adds_to_the_image_falls_with_the_square_of_its_distance():
    """The weight over the image is 2 pi o sqrt(det S): a quarter at twice the distance. The blur alone keeps it."""
    faint = {"alpha_min": 1e-9}
    near, far = (weight_of_one(0.0009, z, RasterSettings(antialiased=True, **faint)) for z in (2.0, 4.0))
    assert near / far == pytest.approx(4, rel=0.02)
    near, far = (weight_of_one(0.0009, z, RasterSettings(**faint)) for z in (2.0, 4.0))
    assert near / far < 2.5


def test_a_large_gaussian_keeps_its_opacity():
    large = single(depth=2.0, opacity=0.8, variance=4.0)
    torch.testing.assert_close(large.render(SMOOTH).alpha, large.render().alpha, rtol=2e-3, atol=0)


def test_a_gaussian_without_area_has_the_least_opacity_and_no_gradient_through_it():
    scene = single(depth=2.0, opacity=0.9, variance=0.04)
    flat = scene._replace(covariances=scene.covariances * torch.tensor([1.0, 0, 0, 0, 0, 1.0])).requires_grad()
    render = flat.render(RasterSettings(antialiased=True, alpha_min=1e-4))
    assert render.alpha.max().item() == pytest.approx(0.9 * reference.LEAST_AREA**0.5, rel=1e-6)
    render.alpha.sum().backward()
    assert flat.covariances.grad is not None
    assert flat.covariances.grad.isfinite().all()


def test_survey_weighs_as_the_image_does():
    scene = small_scene(5)
    size = (scene.view.height, scene.view.width)
    prior = DepthPrior(torch.full(size, 2.0), torch.full(size, int(Label.VERIFIED), dtype=torch.uint8))
    for dtype in (torch.float32, torch.float64):
        part = scene.to(dtype)
        statistics = survey(part.splats, scene.view, prior, SMOOTH)
        torch.testing.assert_close(statistics.alpha, part.render(SMOOTH).alpha)
        assert statistics.weight.sum().item() == pytest.approx(part.render(SMOOTH).alpha.sum().item(), rel=1e-4)

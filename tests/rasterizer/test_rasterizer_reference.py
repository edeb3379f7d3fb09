"""The torch rasterizer against the definition of splatting, its gradients, and space that must be free."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from refusals import refuses
from splat_scenes import Path, Scene, brute_force, make_view, near_edge_of, prior_of, random_scene, single
from torch.autograd import gradcheck

from d2_plugin.protocol import Label
from d2_plugin.rasterizer import DepthPrior, RasterSettings, Splats, rasterize, reference, survey

SETTINGS, SMOOTH = RasterSettings(), RasterSettings(antialiased=True)
TRUSTED = (Label.VERIFIED, Label.AGREED)


@pytest.mark.parametrize("size", [(37, 41), (1, 1), (64, 1)])
@pytest.mark.parametrize(
    ("settings", "radius"),
    [(SETTINGS, 3.0), (RasterSettings(1.5, 1.0, 0.8, 0.02, 0.05, 0.7), 3.0), (SMOOTH, 0.7)],
    ids=["", "others", "antialiased"],
)
def test_image_is_the_compositing_sum_of_the_definition(size, settings, radius) -> None:
    scene = random_scene(sum(size), 120, *size, radius=radius).turned()
    edge, background = near_edge_of(scene.view), torch.tensor([0.2, 0.4, 0.8], dtype=torch.float64)
    found, render = brute_force(scene, settings), scene.render(settings, background=background, near_edge=edge)
    alpha = found.weights.sum(0)
    color = np.einsum("mhw,mc->hwc", found.weights, scene.colors.numpy()) + (1 - alpha)[..., None] * background.numpy()
    np.testing.assert_allclose(render.color.numpy(), color, atol=1e-12)
    depth_sum = np.einsum("mhw,m->hw", found.weights, found.depths)
    np.testing.assert_allclose(render.depth_sum.numpy(), depth_sum, atol=1e-11)
    np.testing.assert_allclose(render.alpha.numpy(), alpha, atol=1e-12)
    np.testing.assert_allclose(render.front.numpy(), found.front(edge).sum(0), atol=1e-12)


@pytest.mark.parametrize("settings", [SETTINGS, SMOOTH], ids=["", "antialiased"])
@pytest.mark.parametrize("weighed", [False, True], ids=["", "reliability"])
def test_survey_sums_the_weights_of_the_definition(weighed, settings) -> None:
    scene = random_scene(3, 120, 36, 34, radius=0.7 if settings.antialiased else 3.0)
    random = np.random.default_rng(0)
    labels = torch.from_numpy(random.integers(0, len(Label), (34, 36)).astype(np.uint8))
    depth = torch.from_numpy(random.uniform(0.5, 6, (34, 36)))
    depth[0, :3] = torch.tensor([0.0, torch.nan, -1.0])  # labelled or not, these are no depths
    r = torch.from_numpy(random.uniform(0, 1, (34, 36)))
    r[1, :5] = torch.tensor([0.0, torch.nan, torch.inf, -1.0, 1.0])
    prior, edge = DepthPrior(depth, labels, reliability=r if weighed else None), near_edge_of(scene.view)
    statistics = survey(scene.splats, scene.view, prior, settings, eps=1e-3, near_edge=edge)

    found = brute_force(scene, settings)
    r = np.where(labels.numpy() == Label.FAR, 0, r.numpy()) if weighed else np.isin(labels.numpy(), TRUSTED)
    counts = np.isfinite(r) & (np.nan_to_num(r) > 0) & (np.nan_to_num(depth.numpy()) > 0)
    w = found.weights * np.where(counts, r, 0)
    safe = np.where(counts, depth.numpy(), 1)
    error = np.abs(found.depths[:, None, None] - safe) / (safe + 1e-3)
    np.testing.assert_allclose(statistics.weight.numpy(), w.sum((1, 2)), atol=1e-12)
    np.testing.assert_allclose(statistics.error.numpy(), (w * error).sum((1, 2)), atol=1e-11)
    np.testing.assert_allclose(statistics.max_weight.numpy(), found.weights.max((1, 2)), atol=1e-12)
    np.testing.assert_allclose(statistics.front.numpy(), found.front(edge).sum((1, 2)), atol=1e-11)
    np.testing.assert_array_equal(statistics.hits.numpy(), (w > 0).sum((1, 2)))
    np.testing.assert_allclose(statistics.alpha.numpy(), found.weights.sum(0), atol=1e-12)
    np.testing.assert_allclose(statistics.depth_sum.numpy(), scene.render(settings).depth_sum.numpy(), atol=1e-12)
    assert statistics.front.sum() > 0.1, "some stand in free space"


def test_screen_offsets_move_the_image_by_pixels() -> None:
    scene = single(size=21)
    shift = torch.tensor([[2.0, -3.0]], dtype=torch.float64)
    still, moved = scene.render().alpha, scene.render(screen_offsets=shift).alpha
    torch.testing.assert_close(moved[5:10, 9:15], still[8:13, 7:13])


def test_antialiased_what_a_small_gaussian_adds_falls_with_the_square_of_its_distance() -> None:
    """The weight over the image is 2 pi o sqrt(det S): a quarter at twice the distance. The blur alone keeps it."""
    ratios = []
    for antialiased in (True, False):
        settings = RasterSettings(antialiased=antialiased, alpha_min=1e-9)
        faint = (single(depth=z, opacity=0.02, variance=0.0009).render(settings).alpha.sum().item() for z in (2.0, 4.0))
        near, far = faint
        ratios.append(near / far)
    assert ratios[0] == pytest.approx(4, rel=0.02)
    assert ratios[1] < 2.5


def test_antialiased_a_gaussian_without_area_has_the_least_opacity_and_no_gradient_through_it() -> None:
    scene = single(depth=2.0, opacity=0.9, variance=0.04)
    flat = scene._replace(covariances=scene.covariances * torch.tensor([1.0, 0, 0, 0, 0, 1.0])).requires_grad()
    render = flat.render(RasterSettings(antialiased=True, alpha_min=1e-4))
    assert render.alpha.max().item() == pytest.approx(0.9 * reference.LEAST_AREA**0.5, rel=1e-6)
    render.alpha.sum().backward()
    assert flat.covariances.grad.isfinite().all()


@pytest.mark.parametrize("settings", [SETTINGS, SMOOTH], ids=["", "antialiased"])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_the_image(seed, settings) -> None:
    width, height = (3, 2) if seed == 0 else (6, 4)
    scene = random_scene(seed, 4, width, height, 2, 0.5 if seed == 2 else 2.0).requires_grad()
    background = torch.rand(2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).requires_grad_()
    offsets = torch.zeros(4, 2, dtype=torch.float64, requires_grad=True)

    def render(means, covariances, opacities, colors, background, offsets):
        splats = Splats(means, covariances, opacities, torch.arange(4))
        options = {"background": background, "screen_offsets": offsets, "near_edge": near_edge_of(scene.view, seed)}
        return tuple(rasterize(splats, colors, scene.view, settings, **options))

    # Every entry of the Jacobian once, a random projection of it (a tenth of the time) for the others.
    every = seed == 0 and settings is SMOOTH
    assert gradcheck(render, (*scene[:4], background, offsets), fast_mode=not every)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariances": torch.zeros(1, 3, 3, dtype=torch.float64)}, r"covariances has shape \(1, 3, 3\)"),
        ({"opacities": torch.zeros(1, 1, dtype=torch.float64)}, "opacities has shape"),
        ({"colors": torch.zeros(2, 3, dtype=torch.float64)}, "colors has shape"),
        ({"colors": torch.zeros(1, 0, dtype=torch.float64)}, "colors has shape"),
        ({"colors": torch.zeros(1, 3)}, "colors is torch.float32"),
        ({"background": torch.zeros(4, dtype=torch.float64)}, "background has shape"),
        ({"screen_offsets": torch.zeros(1, 3, dtype=torch.float64)}, "screen_offsets has shape"),
        ({"view": make_view(0, 5)}, "view is 0x5 pixels"),
        ({"view": dataclasses.replace(make_view(5, 5), K=torch.eye(4))}, r"K \(4, 4\), expected"),
        ({"settings": RasterSettings(alpha_min=0.0)}, "alpha_min > 0"),
    ],
)
def test_what_does_not_fit_together_is_named(changes, message) -> None:
    of_scene = {name: value for name, value in changes.items() if name in Scene._fields}
    options = {name: value for name, value in changes.items() if name not in of_scene}
    refuses(message, single()._replace(**of_scene).render, **options)


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({"depth": torch.ones(15, 14)}, "resample it to the view's height and width"),
        ({"reliability": torch.ones(3, 3)}, r"reliability \(3, 3\) but the view is \(15, 15\): resample it"),
        ({"near_edge": torch.ones(15, 14)}, r"near_edge has shape \(15, 14\), expected \(15, 15\)"),
        ({"near_edge": torch.ones(15, 15, dtype=torch.int64)}, "near_edge is torch.int64, expected floating-point"),
    ],
)
def test_maps_that_do_not_fit_the_view_are_named(maps, message) -> None:
    scene, edge = single(), maps.get("near_edge")
    prior = DepthPrior(torch.ones(15, 15), torch.ones(15, 15, dtype=torch.uint8))
    prior = prior._replace(**{name: map_ for name, map_ in maps.items() if name != "near_edge"})
    refuses(message, survey, scene.splats, scene.view, prior, near_edge=edge)
    if edge is not None:
        refuses(message, scene.render, near_edge=edge)


def test_skew_is_refused_on_every_path(path: Path) -> None:
    view = make_view(15, 15)
    view.K[0, 1] = 2.0
    refuses("skew", single()._replace(view=view).on(path).render)


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


def test_the_near_edge_of_a_prior_is_k_sigmas_before_its_depth() -> None:
    sigma = torch.tensor([[0.0, 0.1, 0.5, math.inf, math.nan, -0.1, 0.1, 0.1, 0.1]])
    depth = torch.tensor([[2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 0.0, math.nan, math.inf]])
    prior = DepthPrior(depth, torch.full((1, 9), Label.MONO, dtype=torch.uint8), sigma=sigma)
    torch.testing.assert_close(prior.near_edge(3.0), torch.tensor([[2.0, 1.4, 0, 0, 0, 0, 0, 0, 0]]))
    far = DepthPrior(torch.tensor([[50.0, 0.0]]), torch.full((1, 2), Label.FAR, dtype=torch.uint8))
    for sigma in (None, torch.tensor([[math.inf, 0.1]]), torch.tensor([[0.3, math.nan]])):
        assert far._replace(sigma=sigma).near_edge(2.0).tolist() == [[50.0, 0.0]], "the depth itself"
    assert far._replace(sigma=torch.full((1, 2), math.inf)).measured, "far pixels alone know free space"
    every = DepthPrior(torch.full((1, len(Label)), 2.0), torch.arange(len(Label), dtype=torch.uint8)[None])
    trusted = [2.0 if label in (Label.VERIFIED, Label.AGREED, Label.FAR) else 0.0 for label in Label]
    assert every.near_edge(3.0).tolist() == [trusted], "without sigma the depth of trusted pixels"

"""Stiff and extreme Gaussians, numbered as in the list of cases that broke other codebases, on every path."""

import math

import pytest
import torch
from splat_scenes import Path, Scene, brute_force, covariance, make_view, near_edge_of, path_of, random_scene, single
from torch import Tensor
from torch.autograd import gradcheck

from d2_plugin.rasterizer import DepthPrior, RasterSettings, Render, Splats, View, rasterize, survey


def with_gradients(scene: Scene, settings: RasterSettings = RasterSettings()) -> tuple[Render, list[Tensor]]:  # noqa: B008
    """The image and the gradients of a loss that weighs its pixels unevenly."""
    leaves = scene.requires_grad()
    render = leaves.render(settings, near_edge=near_edge_of(scene.view))
    g = torch.Generator().manual_seed(0)
    loss = sum((part * torch.randn(part.shape, generator=g).to(part)).sum() for part in render)
    return render, list(torch.autograd.grad(loss, leaves[:4]))


def assert_finite(render: Render, gradients: list[Tensor]) -> None:
    assert all(part.isfinite().all() for part in (*render, *gradients))
    assert render.alpha.min() >= 0
    assert render.front.min() >= 0
    assert (render.front <= render.alpha + 1e-6).all()
    assert render.alpha.max() <= 1


def replace(scene: Scene, index: int, **values: float | list[float]) -> Scene:
    """The scene with some attributes of one Gaussian changed."""
    parts = {name: getattr(scene, name).clone() for name in scene._fields[:4]}
    for name, value in values.items():
        parts[name][index] = torch.tensor(value, dtype=parts[name].dtype)
    return Scene(**parts, view=scene.view)


def only(scene: Scene, rows: Tensor) -> Scene:
    return Scene(*(part[rows] for part in scene[:4]), scene.view)


def assert_dropped(scene: Scene, index: int) -> None:
    """Gaussian `index` is not drawn, has zero gradients, and the others are as if it were not there."""
    keep = torch.arange(len(scene.means), device=scene.means.device) != index
    render, gradients = with_gradients(scene)
    alone, expected = with_gradients(only(scene, keep))
    assert_finite(render, gradients)
    for part, other in zip(render, alone):
        assert torch.equal(part, other)
    for gradient, other in zip(gradients, expected):
        assert (gradient[index] == 0).all()
        torch.testing.assert_close(gradient[keep], other)


@pytest.mark.parametrize("value", [1e38, 1e30])
def test_case_4_exploded_scales_reach_neither_the_tile_count_nor_the_gradients(path: Path, value: float) -> None:
    scene = random_scene(0, 20, 24, 24).on(path)
    assert_finite(*with_gradients(replace(scene, 3, covariances=[value, 0, 0, value, 0, value])))


def test_case_5_a_point_is_drawn_as_wide_as_the_blur(path: Path) -> None:
    render, gradients = with_gradients(single(variance=1e-24, opacity=0.9).on(path))
    assert_finite(render, gradients)
    assert render.alpha[7, 8].item() == pytest.approx(0.9 * math.exp(-0.5 / 0.3), rel=1e-5)


def test_case_6_needles_stay_positive_definite(path: Path) -> None:
    needles = covariance(torch.tensor([1e-6, 1e-3, 1e3]).expand(500, 3), torch.Generator().manual_seed(0))
    render, gradients = with_gradients(random_scene(0, 500, 40, 30)._replace(covariances=needles).on(path))
    assert_finite(render, gradients)
    assert render.alpha.max() > 0.1, "needles are visible"


@pytest.mark.parametrize("depth", [0.2, 0.2 - 1e-7, 0.0, -1e-7, -3.0])
def test_case_7_and_8_at_the_near_plane_at_the_camera_and_behind_it_is_culled(path: Path, depth: float) -> None:
    scene = random_scene(1, 10, 16, 16).on(path)
    assert_dropped(replace(scene, 4, means=[0.0, 0.0, depth]), 4)
    assert_finite(*with_gradients(replace(scene, 4, means=[0.0, 0.0, 0.2 + 1e-6])))  # just in front of it


def beside_the_view() -> Scene:
    """Long Gaussians whose centres lie outside the clamp of 1.3 half fields of view, reaching into the image."""
    view = make_view(12, 10)
    means = torch.tensor([[2.5, 0.1, 2.0], [-0.2, -2.4, 2.1], [2.2, 2.0, 1.5], [0.1, 0.1, 3.0]], dtype=torch.float64)
    packed = torch.tensor([[1.4, 0.1, 0.2, 0.3, 0.1, 0.4]], dtype=torch.float64).repeat(4, 1)
    packed[1] = torch.tensor([0.3, 0.1, 0.1, 1.4, 0.2, 0.4])
    packed[2, 3] = 1.2
    opacities = torch.tensor([0.81, 0.7, 0.6, 0.5], dtype=torch.float64)
    return Scene(means, packed, opacities, torch.linspace(0, 1, 8, dtype=torch.float64).reshape(4, 2), view)


def test_case_9_gradients_are_exact_outside_the_field_of_view_clamp(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = beside_the_view().requires_grad()
    slopes = scene.means[:3, :2].abs() / scene.means[:3, 2:]
    limit = 1.3 * torch.tensor([12, 10]) / (2 * float(scene.view.K[0, 0]))
    assert (slopes > limit).any(1).all(), "the clamp is active"
    assert scene.render().alpha.max() > 0.1

    def render(*parts: Tensor) -> tuple[Tensor, ...]:
        splats = Splats(*parts[:3], torch.arange(4))
        return tuple(rasterize(splats, parts[3], scene.view, near_edge=near_edge_of(scene.view)))

    assert gradcheck(render, scene[:4], fast_mode=True)
    _, exact = with_gradients(beside_the_view())
    for name in ("cpu", "shim"):
        _, fast = with_gradients(beside_the_view().on(path_of(name, monkeypatch)))
        for gradient, other in zip(fast, exact):
            assert (gradient.double() - other).norm() < 1e-4 * other.norm()


def test_case_10_a_gaussian_over_the_whole_image_has_its_exact_color(path: Path) -> None:
    scene = single(depth=5.0, opacity=0.7, variance=1e8, size=100).on(path)
    torch.testing.assert_close(scene.render().color, (0.7 * scene.colors[0]).expand(100, 100, 3), atol=1e-6, rtol=0)
    assert (replace(scene, 0, means=[0.0, 0, -5]).render().alpha == 0).all(), "behind the camera"


def test_case_11_near_and_far_together_keep_their_order_and_a_finite_depth(path: Path) -> None:
    depths = torch.tensor([1e6, 0.01, 1e6 * (1 + 1e-6)], dtype=torch.float64)
    means = torch.nn.functional.pad(depths[:, None], (2, 0))
    packed = (depths[:, None] * 0.1) ** 2 * torch.tensor([1.0, 0, 0, 1, 0, 1])
    scene = Scene(means, packed, torch.full((3,), 0.5), torch.eye(3), make_view(9, 9)).on(path)
    render, gradients = with_gradients(scene, RasterSettings(near=0.005))
    assert_finite(render, gradients)
    expected = torch.tensor([0.25, 0.5, 0.125]).to(render.color)
    torch.testing.assert_close(render.color[4, 4], expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("value", [math.nan, -math.inf])
@pytest.mark.parametrize("name", ["means", "covariances", "opacities", "colors", "screen_offsets"])
def test_case_13_one_bad_number_drops_one_gaussian(path: Path, value: float, name: str) -> None:
    scene = random_scene(4, 12, 16, 16).on(path)
    if name != "screen_offsets":
        bad = getattr(scene, name)[5].clone()
        bad.view(-1)[-1] = value
        assert_dropped(replace(scene, 5, **{name: bad.tolist()}), 5)
        return
    offsets = torch.zeros_like(scene.means[:, :2])
    offsets[5, 1] = value
    others = torch.arange(12, device=scene.means.device) != 5
    for part, other in zip(scene.render(screen_offsets=offsets)[:3], only(scene, others).render()[:3]):
        assert torch.equal(part, other)


@pytest.mark.parametrize("logit", [50.0, -50.0])
def test_case_14_saturated_opacities_are_clamped_and_their_gradients_bounded(path: Path, logit: float) -> None:
    scene = random_scene(5, 60, 16, 16, radius=10.0).on(path)
    scene = scene._replace(opacities=torch.full_like(scene.opacities, logit).sigmoid())
    render, gradients = with_gradients(scene)
    assert_finite(render, gradients)
    if logit < 0:
        assert (render.alpha == 0).all()


def test_case_14_no_gradient_flows_through_a_clamped_alpha(path: Path) -> None:
    scene = single(opacity=1.0, variance=1e6, size=5).on(path).requires_grad()
    render = scene.render(near_edge=torch.full((5, 5), 8.0, device=path.device))
    torch.testing.assert_close(render.alpha, torch.full_like(render.alpha, 0.99))
    assert (torch.autograd.grad(render.alpha.sum(), scene.opacities, retain_graph=True)[0] == 0).all()
    on_means, on_opacities = torch.autograd.grad(render.front.sum(), (scene.means, scene.opacities))
    assert not on_opacities.any()
    assert on_means[0, 2].item() == pytest.approx(-25 * 0.99 / 8, rel=1e-4), "but what stands in front has a depth"


def test_case_15_of_200_opaque_layers_the_hidden_ones_have_exactly_no_gradient(path: Path) -> None:
    layers = [single(depth=1 + 0.01 * i, opacity=0.9, variance=1e4) for i in range(200)]
    scene = Scene(*(torch.cat(parts) for parts in zip(*(layer[:4] for layer in layers))), layers[0].view)
    render, gradients = with_gradients(scene.on(path))
    assert_finite(render, gradients)
    # Transmittance 0.1 ** k reaches 1e-4 with the fourth layer, which is therefore not drawn (or just is, by rounding).
    assert all((gradient[4:] == 0).all() for gradient in gradients)
    assert all((gradient[:3] != 0).any() for gradient in (gradients[2], gradients[3]))


@pytest.mark.parametrize("factor", [1 - 1e-5, 1 + 1e-5])
def test_case_16_the_smallest_alpha_is_cut_alike_forward_and_backward(path: Path, factor: float) -> None:
    render, gradients = with_gradients(single(opacity=factor / 255, variance=0.05).on(path))
    drawn = factor > 1
    assert (render.alpha > 0).sum().item() == (1 if drawn else 0)
    assert not (render.front > 0)[render.alpha == 0].any()
    assert (gradients[3] != 0).any().item() == drawn
    assert_finite(render, gradients)


@pytest.mark.parametrize("count", [0, 10], ids=["none at all", "none visible"])
def test_case_18_nothing_to_draw_is_the_background(path: Path, count: int) -> None:
    scene = only(random_scene(7, 10, 11, 9), torch.arange(count))
    leaves = scene._replace(means=scene.means - 100.0).on(path).requires_grad()
    background = torch.tensor([0.1, 0.2, 0.3]).to(leaves.means).requires_grad_()
    edge = near_edge_of(leaves.view)
    render = leaves.render(background=background, near_edge=edge)
    assert torch.equal(render.color, background.expand(9, 11, 3))
    assert not any(part.any() for part in (render.front, render.alpha, render.depth_sum))
    gradients = torch.autograd.grad(render.color.sum() + render.depth_sum.sum(), (*leaves[:4], background))
    for gradient, leaf in zip(gradients, leaves[:4]):
        assert gradient.shape == leaf.shape
        assert (gradient == 0).all()
    assert (gradients[4] == 99).all()
    prior = DepthPrior(torch.ones(9, 11), torch.full((9, 11), 2, dtype=torch.uint8))
    assert all((part == 0).all() for part in survey(leaves.splats, leaves.view, prior, near_edge=edge))


@pytest.mark.parametrize("channels", [3, 40])
def test_case_20_a_loss_that_divides_by_zero_where_nothing_is_drawn_or_known_spoils_no_gradient(path, channels) -> None:
    scene = single(size=41)._replace(colors=torch.rand(1, channels, dtype=torch.float64)).on(path).requires_grad()
    edge = near_edge_of(scene.view)
    render = scene.render(near_edge=edge)
    drawn, known = render.alpha > 0, edge.isfinite() & (edge > 1e-30)
    assert drawn.any()
    assert not drawn.all()
    assert not render.depth_sum[~drawn].any()
    # 0 / 0 where nothing is drawn or known: NaN upstream there, though masked.
    losses = [(part / render.alpha)[drawn].sum() for part in (render.depth_sum, render.color.sum(-1), render.front)]
    for loss in (*losses, (render.front / known.to(render.front))[known].sum()):
        for gradient in torch.autograd.grad(loss, scene[:3], retain_graph=True):
            assert gradient.isfinite().all()


def test_case_24_the_survey_does_not_depend_on_the_unit_of_length(path: Path) -> None:
    scene = random_scene(8, 40, 20, 20).on(path)
    depth = 1 + 4 * torch.rand(20, 20, generator=torch.Generator().manual_seed(0))
    labels = torch.full((20, 20), 2, dtype=torch.uint8)
    results = []
    for unit in (1e-3, 1.0, 1e6):
        scaled = scene._replace(means=scene.means * unit, covariances=scene.covariances * unit**2)
        prior = DepthPrior((depth.double() * unit).to(path.dtype), labels)
        results.append(survey(scaled.splats, scene.view, prior, RasterSettings(near=0.2 * unit), eps=1e-8 * unit))
    for other in (results[0], results[2]):
        torch.testing.assert_close(other.weight, results[1].weight, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(other.error, results[1].error, rtol=1e-3, atol=1e-3)


def test_case_24_tiny_and_huge_depths_in_one_prior_are_finite(path: Path) -> None:
    scene = random_scene(8, 40, 20, 20).on(path)
    depth = torch.full((20, 20), 1e-3)
    depth[10:] = 1e6
    statistics = survey(scene.splats, scene.view, DepthPrior(depth, torch.full((20, 20), 2, dtype=torch.uint8)))
    assert all(part.isfinite().all() for part in statistics)
    # Far behind its prior a Gaussian's relative error is about 1 per unit of weight, far in front about z / D*.
    assert (statistics.error <= 1.001 * statistics.weight * (5 / 1e-3) + 1e-4).all()


def test_case_37_ties_in_depth_are_drawn_in_the_order_of_indices(path: Path) -> None:
    first, second = single(depth=2.0, opacity=0.75), single(depth=2.0, opacity=0.5)
    scene = Scene(*(torch.cat(pair) for pair in zip(first[:4], second[:4])), first.view)
    scene = replace(scene, 1, colors=[0.0, 0.0, 0.0]).on(path)
    torch.testing.assert_close(scene.render().color[7, 7, 0].item(), 0.75)
    swapped = Scene(*(part.flip(0) for part in scene[:4]), scene.view)
    torch.testing.assert_close(swapped.render().color[7, 7, 0].item(), 0.5 * 0.75)


@pytest.mark.parametrize("principal", [(10.0, 12.0), (-30.0, 9.0), (14.0, 70.0)])
def test_case_39_unequal_focal_lengths_and_a_principal_point_outside_the_image(path: Path, principal: tuple) -> None:
    K = torch.tensor([[30.0, 0, principal[0]], [0, 22.0, principal[1]], [0, 0, 1]])
    scene = random_scene(10, 60, 23, 19)
    pixels = torch.rand(60, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * torch.tensor([23, 19])
    rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    means = torch.cat([rays, torch.ones(60, 1)], 1) * scene.means[:, 2:]
    scene = Scene(means.float().double(), *scene[1:4], View("cam", 0, 0.0, torch.eye(4), K, 23, 19))
    found = brute_force(scene)
    alpha = scene.on(path).render().alpha.cpu().double()
    assert (alpha - torch.from_numpy(found.weights.sum(0)))[found.away()].abs().max() < 1e-4
    assert alpha.max() > 0.3, "they are in the image"


def extreme_scene(seed: int, count: int) -> Scene:
    """Scales 10^-6..10^3, opacity logits -20..20, depths 10^-3..10^6: all independent, in and around the view."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    depth = 10 ** (9 * draw(count, 1) - 3)
    means = torch.cat([(draw(count, 2) - 0.5) * 4 * depth, depth], 1)
    packed = covariance(10 ** (9 * draw(count, 3) - 6), g)
    opacities = (40 * draw(count) - 20).sigmoid()
    return Scene(means, packed, opacities, draw(count, 3), make_view(40, 30))


@pytest.mark.parametrize(("name", "seeds"), [("cpu", 60), ("shim", 4), ("torch", 3)])
def test_case_41_thousands_of_extreme_gaussians_leave_everything_finite(name: str, seeds: int, monkeypatch) -> None:
    path, drawn = path_of(name, monkeypatch), 0
    prior = DepthPrior(torch.rand(30, 40) + 0.5, torch.full((30, 40), 2, dtype=torch.uint8))
    for seed in range(seeds):
        scene = extreme_scene(seed, 200).on(path)
        render, gradients = with_gradients(scene, RasterSettings(near=1e-3))
        assert_finite(render, gradients)
        seen = render.alpha > 0.1
        depth = (render.depth_sum / render.alpha)[seen]
        assert (depth > 0.99e-3).all()
        assert (depth < 1.01e6).all()
        edge = near_edge_of(scene.view)
        statistics = survey(scene.splats, scene.view, prior, RasterSettings(near=1e-3), near_edge=edge)
        assert all(part.isfinite().all() for part in statistics)
        drawn += int((statistics.max_weight > 0).sum())
    assert drawn > 2 * seeds, "enough of them are seen"

"""Stiff and extreme cases around rendered depth, its loss, starting points and images, numbered as in the list of
cases that broke other codebases; those of the rasterizer and of the slice have files of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles.surface import back_project
from splat_scenes import random_scene, single
from tiny import BACKBONES, make_model, make_views
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.backbones.starting import nearest_neighbour_scales
from d2_plugin.gaussians.photometric import photometric_loss, ssim
from d2_plugin.hooks.depth_loss import charbonnier, depth_loss
from d2_plugin.hooks.rendered_depth import EPSILON, rendered_depth
from d2_plugin.priors.geometry import pixel_grid, view_pair
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs import metrics

TAU_V = 0.5
both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


def leaf(*values: float, dtype: torch.dtype) -> Tensor:
    return torch.tensor([values], dtype=dtype, requires_grad=True)


# ---------------------------------------------------------------- Gaussians that are not there


@pytest.mark.parametrize("backbone", BACKBONES)
def test_case_18_a_model_whose_gaussians_were_all_pruned_renders_the_background_and_can_grow_again(
    backbone: str,
) -> None:
    model, view = make_model(backbone=backbone), make_views()[0]
    model.deforms = True
    rows = {name: value.detach()[:2].clone() for name, value in model.gaussians.parameters.items()}
    model.select(torch.arange(0))
    background = torch.tensor([0.1, 0.2, 0.3])
    render = model.render(view, background)
    assert torch.equal(render.color, background.expand_as(render.color))
    assert not render.alpha.any()
    render.color.sum().backward()
    model.optimize(1, 10)
    model.append(rows)
    assert len(model) == 2
    assert all(part.isfinite().all() for part in model.render(view)[:3])


@both
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_case_19_few_points_start_with_a_finite_scale_whether_apart_or_in_one_place(count: int, dtype) -> None:
    apart = nearest_neighbour_scales(torch.eye(4, 3, dtype=dtype)[:count])
    together = nearest_neighbour_scales(torch.ones(count, 3, dtype=dtype))
    for scales in (apart, together):
        assert scales.shape == (count,)
        assert scales.isfinite().all()
        assert ((scales >= 1e-7) & (scales < 10)).all()


# ---------------------------------------------------------------- D = sum(w z) / (A + eps)


@both
def test_case_20_where_nothing_is_rendered_the_depth_loss_and_its_gradients_are_exactly_zero(dtype) -> None:
    depth_sum, alpha = leaf(0.0, 0.0, dtype=dtype), leaf(0.0, 1e-30, dtype=dtype)
    depth, valid = rendered_depth(depth_sum, alpha, TAU_V)
    loss = depth_loss(depth, valid, torch.full_like(alpha, 3.0), torch.ones_like(valid), 0.01)
    loss.backward()
    assert not valid.any()
    assert loss.item() == 0
    assert not depth.any()
    assert not depth_sum.grad.any()
    assert not alpha.grad.any()


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


@both
def test_case_23_half_a_gaussian_at_depth_4_is_at_depth_4(dtype) -> None:
    render = single(depth=4.0, opacity=0.5, variance=1.0, dtype=dtype).render()
    assert render.depth_sum[7, 7].item() == pytest.approx(2, rel=1e-3), "accumulated, not normalised"
    assert rendered_depth(render.depth_sum, render.alpha, 0.25)[0][7, 7].item() == pytest.approx(4, rel=1e-6)


@both
def test_case_24_a_millimetre_and_a_thousand_kilometres_in_one_image_weigh_alike(dtype) -> None:
    prior = torch.tensor([[1e-3, 1e6]], dtype=dtype)
    depth, everywhere = (1.1 * prior).requires_grad_(), torch.ones(1, 2, dtype=torch.bool)
    loss = depth_loss(depth, everywhere, prior, everywhere, 0.01)
    assert loss.item() == pytest.approx(charbonnier(torch.tensor(0.1), 0.01).item(), rel=1e-3)
    loss.backward()
    torch.testing.assert_close(*(depth.grad * prior).unbind(1), rtol=1e-3, atol=0)


@both
@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_case_24_the_depth_loss_does_not_depend_on_the_unit_of_length(unit: float, dtype) -> None:
    prior = 2 + torch.rand(8, 9, generator=torch.Generator().manual_seed(0), dtype=dtype)
    everywhere = torch.ones(8, 9, dtype=torch.bool)
    here, there = (depth_loss(1.05 * prior * u, everywhere, prior * u, everywhere, 0.01).item() for u in (1.0, unit))
    assert there == pytest.approx(here, rel=1e-4)


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


# ---------------------------------------------------------------- order, sizes, pixels


def test_case_37_ties_are_drawn_alike_on_one_and_two_threads() -> None:
    scene = random_scene(5, 400, 64, 64).to(torch.float32)
    scene = scene._replace(means=torch.cat([scene.means[:, :2], torch.full((400, 1), 3.0)], 1))
    threads = torch.get_num_threads()
    renders = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            renders.append(scene.render())
    finally:
        torch.set_num_threads(threads)
    for one, two in zip(*(render[:3] for render in renders)):
        assert torch.equal(one, two)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (3, 40)])
def test_case_38_a_image_smaller_than_the_window_of_ssim_is_compared_or_refused_in_a_sentence(size) -> None:
    g = torch.Generator().manual_seed(0)
    a, b = (torch.rand(*size, 3, generator=g) for _ in range(2))
    assert ssim(a, a).item() == pytest.approx(1, abs=1e-5)
    image = a.requires_grad_()
    photometric_loss(image, b).backward()
    assert image.grad.isfinite().all()
    with pytest.raises(D2Error, match="window"):
        metrics.ssim_range1(a.detach(), b)


def test_case_39_a_point_comes_back_from_its_pixel_to_a_hundred_thousandth_of_a_pixel() -> None:
    camera = next(iter(synthetic_recording(frames=1).cameras.values()))
    K = np.array([[180.0, 0, -40.0], [0, 150.0, 300.0], [0, 0, 1]])  # fx != fy, principal point outside the image
    camera = replace(camera, K=K)
    depth = np.random.default_rng(0).uniform(0.5, 50, (camera.height, camera.width))
    points = back_project(camera, depth) @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = points @ K.T
    u, v = pixel_grid(camera, np.float64)
    assert np.abs(pixels[..., 0] / pixels[..., 2] - 0.5 - u).max() < 1e-5
    assert np.abs(pixels[..., 1] / pixels[..., 2] - 0.5 - v).max() < 1e-5


def test_case_39_true_depth_carries_the_pixels_of_one_view_onto_the_same_surface_in_another() -> None:
    recording = synthetic_recording(2, 0, frames=1, width=160, height=90, arc_degrees=8)
    one, other = recording.cameras.values()
    depth, truth = (recording.depth(camera.name, 0).astype(np.float64) for camera in (one, other))
    there = view_pair(one, other).project(*pixel_grid(one, np.float64), depth)
    points = back_project(one, depth) @ other.T_camera_world[:3, :3].T + other.T_camera_world[:3, 3]
    pixels = points @ other.K.T
    assert np.abs(pixels[..., 0] / pixels[..., 2] - 0.5 - there.x).max() < 0.05
    columns, rows = np.rint(there.x).astype(int), np.rint(there.y).astype(int)
    inside = (columns >= 0) & (columns < other.width) & (rows >= 0) & (rows < other.height)
    seen = truth[rows[inside], columns[inside]]
    same = np.abs(there.z[inside] / seen - 1) < 0.02
    assert same.mean() > 0.8, "most of it is seen by both"

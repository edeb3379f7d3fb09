"""The torch rasterizer against the definition of splatting, pixel by pixel, and its gradients against differences."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from splat_scenes import Scene, brute_force, make_view, near_edge_of, random_scene, single
from torch.autograd import gradcheck

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Label
from d2_plugin.rasterizer import DepthPrior, RasterSettings, Splats, View, rasterize, survey

SETTINGS = RasterSettings()
TRUSTED = (Label.VERIFIED, Label.AGREED)


def rotated(scene: Scene) -> Scene:
    """The same scene in another world frame, so that the camera is not at the origin."""
    angle = torch.tensor(0.7, dtype=torch.float64)
    cos, sin = angle.cos(), angle.sin()
    R = torch.eye(3, dtype=torch.float64)
    R[0, 0], R[0, 2], R[2, 0], R[2, 2] = cos, sin, -sin, cos
    t = torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64)
    xx, xy, xz, yy, yz, zz = scene.covariances.unbind(1)
    full = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)
    full = R.T @ full @ R
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = R, t
    view = View("cam", 0, 0.0, pose, scene.view.K, scene.view.width, scene.view.height)
    packed = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return Scene((scene.means - t) @ R, packed, scene.opacities, scene.colors, view)


@pytest.mark.parametrize("settings", [SETTINGS, RasterSettings(1.5, 1.0, 0.8, 0.02, 0.05, 0.7)], ids=["", "others"])
@pytest.mark.parametrize("size", [(37, 41), (1, 1), (7, 5), (33, 31), (64, 1)])
def test_image_is_the_compositing_sum_of_the_definition(size, settings):
    scene = random_scene(sum(size), 150, *size)
    found, render = brute_force(scene, settings), scene.render(settings)
    color = np.einsum("mhw,mc->hwc", found.weights, scene.colors.numpy())
    np.testing.assert_allclose(render.color.numpy(), color, atol=1e-12)
    depth_sum = np.einsum("mhw,m->hw", found.weights, found.depths)
    np.testing.assert_allclose(render.depth_sum.numpy(), depth_sum, atol=1e-11)
    np.testing.assert_allclose(render.alpha.numpy(), found.weights.sum(0), atol=1e-12)


def test_a_moved_world_gives_the_same_image():
    scene = random_scene(5, 80, 24, 20)
    for part, other in zip(scene.render()[:3], rotated(scene).render()[:3]):
        torch.testing.assert_close(part, other, atol=1e-10, rtol=0)


def test_one_gaussian_has_its_opacity_at_its_centre_and_falls_off_with_its_screen_covariance():
    scene = single(depth=2.0, opacity=0.8, variance=0.04)
    focal = float(scene.view.K[0, 0])
    variance = 0.04 * (focal / 2) ** 2 + SETTINGS.blur
    alpha = scene.render().alpha
    assert alpha[7, 7].item() == pytest.approx(0.8, abs=1e-12)
    assert alpha[7, 9].item() == pytest.approx(0.8 * math.exp(-0.5 * 4 / variance), abs=1e-12)


def test_the_nearer_gaussian_hides_the_farther_one_whatever_their_order():
    near, far = single(depth=2.0, opacity=0.6), single(depth=3.0, opacity=0.9)
    for first, second in ((near, far), (far, near)):
        both = Scene(*(torch.cat(pair) for pair in zip(first[:4], second[:4])), near.view)
        assert both.render().depth_sum[7, 7].item() == pytest.approx(0.6 * 2 + 0.4 * 0.9 * 3)


def test_background_shines_through_what_is_left_transparent():
    background = torch.tensor([0.2, 0.4, 0.8], dtype=torch.float64)
    scene = single(opacity=0.5)
    color = scene.render(background=background).color
    torch.testing.assert_close(color[7, 7], 0.5 * scene.colors[0] + 0.5 * background)
    torch.testing.assert_close(color[0, 0], background)


def test_screen_offsets_move_the_image_by_pixels():
    scene = single(size=21)
    shift = torch.tensor([[2.0, -3.0]], dtype=torch.float64)
    still, moved = scene.render().alpha, scene.render(screen_offsets=shift).alpha
    torch.testing.assert_close(moved[5:10, 9:15], still[8:13, 7:13])


def test_gradient_of_screen_offsets_is_that_of_the_screen_mean():
    scene = random_scene(0, 20, 12, 10).requires_grad()
    offsets = torch.zeros(20, 2, dtype=torch.float64, requires_grad=True)
    render = scene.render(screen_offsets=offsets)
    weight = torch.rand(10, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grad = torch.autograd.grad((render.alpha * weight).sum(), offsets)[0]
    step = 1e-6
    for i in (3, 11):
        change = torch.zeros_like(offsets)
        change[i, 1] = step
        ahead, behind = (scene.render(screen_offsets=sign * change).alpha for sign in (1, -1))
        assert grad[i, 1].item() == pytest.approx(((ahead - behind) * weight).sum().item() / (2 * step), abs=1e-6)


@pytest.mark.parametrize("settings", [SETTINGS, RasterSettings(antialiased=True)], ids=["", "antialiased"])
@pytest.mark.parametrize("seed", range(25))
def test_gradients_are_those_of_the_image(seed, settings):
    scene = random_scene(seed, 4, 7, 5, channels=2, radius=0.5 if seed % 3 == 2 else 2.0).requires_grad()
    background = torch.rand(2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).requires_grad_()
    offsets = torch.zeros(4, 2, dtype=torch.float64, requires_grad=True)

    def render(means, covariances, opacities, colors, background, offsets):
        splats = Splats(means, covariances, opacities, torch.arange(4))
        options = {"background": background, "screen_offsets": offsets, "near_edge": near_edge_of(scene.view, seed)}
        return tuple(rasterize(splats, colors, scene.view, settings, **options))

    # Every entry of the Jacobian for some seeds, a random projection of it (a tenth of the time) for the others.
    assert gradcheck(render, (*scene[:4], background, offsets), fast_mode=seed >= 3), f"seed {seed}"


@pytest.mark.parametrize("weighed", [False, True], ids=["", "reliability"])
def test_survey_sums_the_weights_of_the_definition(weighed):
    scene = random_scene(3, 120, 36, 34)
    random = np.random.default_rng(0)
    labels = torch.from_numpy(random.integers(0, len(Label), (34, 36)).astype(np.uint8))
    depth = torch.from_numpy(random.uniform(0.5, 6, (34, 36)))
    depth[0, :3] = torch.tensor([0.0, torch.nan, -1.0])  # labelled or not, these are no depths
    r = torch.from_numpy(random.uniform(0, 1, (34, 36)))
    r[1, :5] = torch.tensor([0.0, torch.nan, torch.inf, -1.0, 1.0])
    prior = DepthPrior(depth, labels, reliability=r if weighed else None)
    statistics = survey(scene.splats, scene.view, prior, eps=1e-3)

    found = brute_force(scene)
    r = np.where(labels.numpy() == Label.FAR, 0, r.numpy()) if weighed else np.isin(labels.numpy(), TRUSTED)
    counts = np.isfinite(r) & (np.nan_to_num(r) > 0) & (np.nan_to_num(depth.numpy()) > 0)
    w = found.weights * np.where(counts, r, 0)
    safe = np.where(counts, depth.numpy(), 1)
    error = np.abs(found.depths[:, None, None] - safe) / (safe + 1e-3)
    np.testing.assert_allclose(statistics.weight.numpy(), w.sum((1, 2)), atol=1e-12)
    np.testing.assert_allclose(statistics.error.numpy(), (w * error).sum((1, 2)), atol=1e-11)
    np.testing.assert_allclose(statistics.max_weight.numpy(), found.weights.max((1, 2)), atol=1e-12)
    np.testing.assert_array_equal(statistics.hits.numpy(), (w > 0).sum((1, 2)))
    np.testing.assert_allclose(statistics.alpha.numpy(), found.weights.sum(0), atol=1e-12)
    np.testing.assert_allclose(statistics.depth_sum.numpy(), scene.render().depth_sum.numpy(), atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("label", Label)
def test_survey_counts_verified_and_agreed_pixels_and_no_others(label, dtype):
    scene = single(opacity=0.5, dtype=dtype)
    prior = DepthPrior(torch.full((15, 15), 3.0), torch.full((15, 15), label, dtype=torch.uint8))
    statistics = survey(scene.splats, scene.view, prior)
    alpha = scene.render().alpha
    counted = label in TRUSTED
    assert statistics.hits.item() == (alpha > 0).sum().item() * counted
    assert statistics.weight.item() == pytest.approx(alpha.sum().item() * counted, rel=1e-5)
    assert statistics.error.item() == pytest.approx(alpha.sum().item() * counted * (4 - 3) / 3, rel=1e-5)


def bad(scene: Scene, **changes: object) -> tuple:
    values = {**scene._asdict(), "settings": SETTINGS, "background": None, "screen_offsets": None, **changes}
    splats = Splats(values["means"], values["covariances"], values["opacities"], torch.arange(1))
    return splats, values["colors"], values["view"], values["settings"], values["background"], values["screen_offsets"]


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
def test_what_does_not_fit_together_is_named(changes, message):
    splats, colors, view, settings, background, offsets = bad(single(), **changes)
    with pytest.raises(D2Error, match=message):
        rasterize(splats, colors, view, settings, background=background, screen_offsets=offsets)


def test_a_prior_of_another_size_is_refused():
    prior = DepthPrior(torch.ones(15, 14), torch.ones(15, 14, dtype=torch.uint8))
    with pytest.raises(D2Error, match="resample it to the view's height and width"):
        survey(single().splats, single().view, prior)


def test_skew_is_refused_on_every_path():
    view = make_view(15, 15)
    view.K[0, 1] = 2.0
    for dtype in (torch.float32, torch.float64):
        with pytest.raises(D2Error, match="skew"):
            single(dtype=dtype)._replace(view=view).render()

"""The depth loss in the kernel is the one in torch: value, gradients, extremes, threads."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from d2_plugin.hooks import depth_loss as module
from d2_plugin.hooks import native_depth_loss as kernel
from d2_plugin.hooks.depth_loss import DepthLossConfig, pixel_depth_loss
from d2_plugin.hooks.prior import KnownPixels, PriorLoader, PriorPixels
from d2_plugin.hooks.rendered_depth import rendered_depth
from d2_plugin.protocol import DepthPrior, Label, View


@pytest.fixture(autouse=True)
def compiled() -> None:
    if kernel.library() is None:
        pytest.skip("there is no C++ compiler")


def case(height: int = 90, width: int = 130, known: float = 0.8) -> tuple[Tensor, Tensor, KnownPixels]:
    """Depth sum and alpha of a render, and what is known: verified, uncertain and far pixels."""
    g = torch.Generator().manual_seed(0)
    alpha = torch.rand(height, width, generator=g)
    depth = 1 + 9 * torch.rand(height, width, generator=g)
    index = (torch.rand(height * width, generator=g) < known).nonzero()[:, 0]
    prior = (depth.flatten() * (1 + 0.1 * torch.randn(height * width, generator=g)))[index]
    far = torch.rand(len(index), generator=g) < 0.2
    sigma = (0.2 * torch.rand(len(index), generator=g)).masked_fill(far, 0)
    return depth * alpha, alpha, KnownPixels(index, prior, sigma, far)


def found(
    depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels, dtype: torch.dtype = torch.float32, factor: float = 1.0
) -> list[Tensor]:
    leaves = [part.to(dtype).requires_grad_() for part in (depth_sum, alpha)]
    wide = KnownPixels(pixels.index, pixels.depth.to(dtype), pixels.sigma.to(dtype), pixels.far)
    loss = factor * pixel_depth_loss(*leaves, wide, DepthLossConfig())
    return [loss.detach(), *torch.autograd.grad(loss, leaves)]


@pytest.mark.parametrize("known", [1e-3, 0.3, 1.0])
def test_value_and_gradients_are_those_of_torch_in_float64(known: float) -> None:
    for one, exact in zip(found(*case(known=known)), found(*case(known=known), torch.float64), strict=True):
        assert one.dtype == torch.float32
        assert (one - exact).norm() <= 2e-6 * exact.norm()


def test_only_known_pixels_have_a_gradient_and_it_scales_with_what_comes_back() -> None:
    depth_sum, alpha, pixels = case()
    once, thrice = found(depth_sum, alpha, pixels), found(depth_sum, alpha, pixels, factor=3.0)
    unknown = torch.ones(alpha.numel(), dtype=torch.bool)
    unknown[pixels.index] = False
    for one, three in zip(once[1:], thrice[1:], strict=True):
        assert not one.flatten()[unknown].any()
        torch.testing.assert_close(three, 3 * one)


@pytest.mark.usefixtures("threads")
def test_any_number_of_threads_gives_the_same_bits() -> None:
    results = []
    for count in (1, 2, 4):
        torch.set_num_threads(count)
        results.append(found(*case()))
    assert all(torch.equal(*pair) for result in results[1:] for pair in zip(results[0], result, strict=True))


@pytest.mark.parametrize("scale", [1e-20, 1e20, 1e30])
def test_depths_beyond_the_range_of_squares_are_as_in_torch(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    depth_sum, alpha, pixels = case(20, 30)
    native = found(scale * depth_sum, alpha, pixels)
    monkeypatch.setattr(module, "can_compare", lambda *parts: False)
    assert all(part.isfinite().all() for part in native)
    torch.testing.assert_close(native, found(scale * depth_sum, alpha, pixels), rtol=1e-4, atol=1e-30)


def test_a_render_that_covers_nothing_has_the_opaque_term_alone() -> None:
    depth_sum, alpha, pixels = case(20, 30)
    loss, by_depth, by_alpha = found(0 * depth_sum, 0 * alpha, pixels)
    torch.testing.assert_close(loss.item(), DepthLossConfig().opaque)
    assert not by_depth.any()
    near = pixels.index[~pixels.far]
    expected = torch.full((len(near),), -DepthLossConfig().opaque / len(near))
    torch.testing.assert_close(by_alpha.flatten()[near], expected)


def test_nan_in_a_known_pixel_is_seen() -> None:
    depth_sum, alpha, pixels = case(20, 30)
    alpha.view(-1)[pixels.index[3]] = math.nan
    assert found(depth_sum, alpha, pixels)[0].isnan()


def test_no_known_pixel_is_for_torch() -> None:
    depth_sum, alpha, pixels = case(20, 30, known=0.0)
    assert not kernel.can_compare(depth_sum, alpha, pixels)
    assert found(depth_sum, alpha, pixels)[0] == 0


LABELS = (Label.EMPTY, Label.MONO, Label.VERIFIED, Label.CONFLICT, Label.AGREED, Label.FAR)


def prior_of(seed: int, height: int, width: int, labels: tuple[Label, ...] = LABELS, paper: bool = False) -> DepthPrior:
    """A prior as a store gives it: numbers that mean nothing wherever nothing is known."""
    g = torch.Generator().manual_seed(seed)
    kinds = torch.tensor(labels, dtype=torch.uint8)[torch.randint(len(labels), (height, width), generator=g)]
    depth = 1 + 9 * torch.rand(height, width, generator=g)
    depth[(kinds == Label.EMPTY) | (kinds == Label.CONFLICT)] = math.nan
    sigma = 0.2 * torch.rand(height, width, generator=g)
    sigma[torch.rand(height, width, generator=g) < 0.1] = math.inf
    sigma[torch.rand(height, width, generator=g) < 0.1] = 0
    return DepthPrior(depth, kinds, sigma=None if paper else sigma)


def torch_found(
    depth_sum: Tensor, alpha: Tensor, prior: DepthPrior, config: DepthLossConfig, factor: float
) -> list[Tensor]:
    """The same in float64, of full maps, in plain torch operations."""
    z, a = (part.double().requires_grad_() for part in (depth_sum, alpha))
    far = prior.far
    sigma = torch.where(prior.trusted, 0.0, math.inf) if prior.sigma is None else prior.sigma.double()
    sigma = torch.where(far, 0.0, torch.where(prior.support, sigma, math.inf)).double()
    weight = (config.sigma_full / sigma).clamp(max=1)
    depth = torch.where(weight > 0, prior.depth.double(), 1.0)
    epsilon = torch.hypot(torch.where(weight > 0, sigma, 0.0), torch.tensor(config.epsilon).double())
    loss = module.depth_loss(*rendered_depth(z, a, config.tau_v), depth, weight, epsilon, far)
    near = (weight > 0) & ~far
    loss = factor * (loss + config.opaque * (1 - a)[near].sum() / max(int(near.sum()), 1))
    return [loss.detach(), *torch.autograd.grad(loss, (z, a))]


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (3, 5), (61, 67), (90, 130)])
@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize("factor", [1.0, 0.2])
def test_a_prior_as_it_is_kept_gives_what_full_maps_give_in_float64(
    size: tuple[int, int], paper: bool, factor: float
) -> None:
    config = DepthLossConfig()
    for seed in range(4):
        prior = prior_of(seed, *size, paper=paper)
        g = torch.Generator().manual_seed(seed + 10)
        alpha = torch.rand(size, generator=g)
        depth_sum = alpha * (1 + 9 * torch.rand(size, generator=g))
        pixels, leaves = PriorPixels(prior), [depth_sum.clone().requires_grad_(), alpha.clone().requires_grad_()]
        if not pixels.count:
            continue
        loss = pixel_depth_loss(*leaves, pixels, config, factor)
        exact = torch_found(depth_sum, alpha, prior, config, factor)
        for one, other in zip([loss.detach(), *torch.autograd.grad(loss, leaves)], exact, strict=True):
            assert (one - other).norm() <= 3e-6 * other.norm(), f"seed {seed}"


def test_a_prior_of_far_pixels_alone_lets_nothing_through_wrongly() -> None:
    prior = prior_of(0, 9, 21, (Label.FAR,))
    depth_sum, alpha = torch.full((9, 21), 1e6), torch.full((9, 21), 0.3)
    loss, by_depth, by_alpha = found_of(depth_sum, alpha, PriorPixels(prior))
    assert loss == 0
    assert not by_depth.any()
    assert not by_alpha.any()


def found_of(depth_sum: Tensor, alpha: Tensor, pixels: KnownPixels) -> list[Tensor]:
    leaves = [depth_sum.clone().requires_grad_(), alpha.clone().requires_grad_()]
    loss = pixel_depth_loss(*leaves, pixels, DepthLossConfig())
    return [loss.detach(), *torch.autograd.grad(loss, leaves)]


def test_the_list_of_a_prior_is_what_its_maps_say() -> None:
    for paper in (False, True):
        prior = prior_of(1, 40, 50, paper=paper)
        pixels = PriorPixels(prior)
        listed = KnownPixels(pixels.index, pixels.depth, pixels.sigma, pixels.far)
        assert (pixels.count, pixels.near) == (listed.count, listed.near)
        assert not listed.depth.isnan().any()
        maps, own = listed.maps(2000), pixels.maps(2000)
        assert torch.equal(maps.kind, own.kind)
        for one, other in zip(found_of(*render_of(40, 50), listed), found_of(*render_of(40, 50), pixels), strict=True):
            assert torch.equal(one, other)


def render_of(height: int, width: int) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(5)
    alpha = torch.rand(height, width, generator=g)
    return alpha * (1 + 9 * torch.rand(height, width, generator=g)), alpha


def test_what_is_kept_beside_a_prior_is_a_byte_a_pixel() -> None:
    pixels = PriorPixels(prior_of(0, 90, 130))
    found_of(*render_of(90, 130), pixels)
    assert pixels.bytes == 90 * 130
    pixels.far.any()
    assert pixels.bytes > 90 * 130


@pytest.mark.parametrize("epsilon", [1e-30, 1e-12, 1e20])
@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e30])
def test_spreads_beyond_the_range_of_squares_are_as_in_float64(epsilon: float, sigma: float) -> None:
    prior = prior_of(3, 20, 30, (Label.VERIFIED, Label.MONO))._replace(sigma=torch.full((20, 30), sigma))
    config = DepthLossConfig(epsilon=epsilon)
    depth_sum, alpha = render_of(20, 30)
    leaves = [depth_sum.clone().requires_grad_(), alpha.clone().requires_grad_()]
    loss = pixel_depth_loss(*leaves, PriorPixels(prior), config)
    exact = torch_found(depth_sum, alpha, prior, config, 1.0)
    for one, other in zip([loss.detach(), *torch.autograd.grad(loss, leaves)], exact, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-12)


def test_backward_twice_adds_the_same_again_and_second_derivatives_are_refused() -> None:
    depth_sum, alpha, pixels = case(20, 30)
    leaves = [depth_sum.requires_grad_(), alpha.requires_grad_()]
    loss = pixel_depth_loss(*leaves, pixels, DepthLossConfig())
    loss.backward(retain_graph=True)
    once = [leaf.grad.clone() for leaf in leaves]
    (loss + alpha.sum()).backward(retain_graph=True)
    loss.backward()
    torch.testing.assert_close(leaves[0].grad, 3 * once[0])
    torch.testing.assert_close(leaves[1].grad, 3 * once[1] + 1)
    loss = pixel_depth_loss(*leaves, pixels, DepthLossConfig())
    (slope,) = torch.autograd.grad(loss, leaves[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable|does not require grad"):
        slope.sum().backward()


def test_without_gradients_the_value_is_the_same() -> None:
    depth_sum, alpha, pixels = case(20, 30)
    with torch.no_grad():
        alone = pixel_depth_loss(depth_sum.requires_grad_(), alpha.requires_grad_(), pixels, DepthLossConfig())
    assert not alone.requires_grad
    assert alone == found(depth_sum.detach(), alpha.detach(), pixels)[0]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_hook_adds_the_weighted_mean_of_a_batch(count: int) -> None:
    hook = module.DepthLoss(DepthLossConfig(weight=0.7))
    cases = [(*render_of(20, 30), PriorPixels(prior_of(seed, 20, 30))) for seed in range(count)]
    renders = [tuple(part.clone().requires_grad_() for part in case[:2]) for case in cases]
    backbone = SimpleNamespace(rendered_depth=lambda view: renders[view])
    prior = SimpleNamespace(known=lambda view: cases[view][2] if view < count else None)
    term = hook.loss(SimpleNamespace(backbone=backbone, prior=prior, views=range(count + 1)))
    alone = [found_of(*case) for case in cases]
    torch.testing.assert_close(term.detach(), 0.7 * torch.stack([loss for loss, *_ in alone]).mean())
    for render, (_, *slopes) in zip(renders, alone, strict=True):
        for one, other in zip(torch.autograd.grad(term, render, retain_graph=True), slopes, strict=True):
            torch.testing.assert_close(one, 0.7 / count * other)


def test_eighty_views_of_640x360_stay_in_memory() -> None:
    prior = prior_of(0, 36, 64)
    loader = PriorLoader(SimpleNamespace(prior=lambda camera, frame: prior), keep_bytes=(512 << 20) // 100)
    views = [View("a", frame, 0.0, torch.eye(4), torch.eye(3), 64, 36) for frame in range(80)]
    first = [loader.known(view) for view in views]
    assert all(loader.known(view) is pixels for view, pixels in zip(views, first, strict=True))

"""The depth loss in the kernel is the one in torch: value, gradients, extremes, threads."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from d2_plugin.hooks import depth_loss as module
from d2_plugin.hooks import native_depth_loss as kernel
from d2_plugin.hooks.depth_loss import DepthLossConfig, pixel_depth_loss
from d2_plugin.hooks.prior import KnownPixels


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

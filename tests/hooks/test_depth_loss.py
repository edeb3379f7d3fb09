"""Verified-depth supervision: the penalty, the loss of full maps, and the fast form that the hook uses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.hooks.depth_loss import DepthLossConfig, charbonnier, depth_loss, pixel_depth_loss
from d2_plugin.hooks.prior import KnownPixels
from d2_plugin.hooks.rendered_depth import rendered_depth

PAPER = DepthLossConfig(tau_v=0.5, epsilon=0.01, opaque=0)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values)


def known(depth: torch.Tensor, verified: torch.Tensor) -> KnownPixels:
    """The verified pixels of a map, as the paper knows them: exactly."""
    depths = depth[verified]
    return KnownPixels(
        torch.nonzero(verified.flatten()).squeeze(1), depths, torch.zeros_like(depths), torch.zeros_like(depths) > 0
    )


class TestCharbonnier:
    def test_equals_the_formula(self) -> None:
        r = torch.linspace(-3, 3, 31, dtype=torch.float64)
        torch.testing.assert_close(charbonnier(r, 0.1), torch.sqrt(r**2 + 0.01) - 0.1)

    def test_equals_kornia_rescaled(self) -> None:
        kornia = pytest.importorskip("kornia", reason="kornia is in the `test` extra")
        r = torch.linspace(-3, 3, 31, dtype=torch.float64)
        expected = 0.1 * kornia.losses.charbonnier_loss(r / 0.1, torch.zeros_like(r))
        torch.testing.assert_close(charbonnier(r, 0.1), expected)

    @pytest.mark.parametrize("value", [0.0, 1e-30, 1e20])
    def test_is_finite_with_finite_gradient_at_extremes_in_float32(self, value: float) -> None:
        r = torch.tensor([value], requires_grad=True)
        loss = charbonnier(r, 0.01)
        loss.sum().backward()
        assert torch.isfinite(loss).all()
        assert torch.isfinite(r.grad).all()
        assert loss.item() == pytest.approx(value if value > 1 else 0.0, rel=1e-6, abs=1e-12)
        if value == 0:
            assert r.grad.item() == 0


class TestDepthLoss:
    def test_counts_only_pixels_that_are_trusted_and_validly_rendered(self) -> None:
        depth, prior = tensor(2.0, 2.0, 2.0), tensor(1.0, 4.0, 8.0)
        valid, verified = torch.tensor([True, True, False]), torch.tensor([True, False, True])
        expected = charbonnier(tensor(1.0), 0.01).squeeze()
        torch.testing.assert_close(depth_loss(depth, valid, prior, verified, 0.01), expected)

    def test_no_common_pixel_gives_zero_loss_and_zero_gradient(self) -> None:
        depth = torch.ones(4, requires_grad=True)
        loss = depth_loss(depth, torch.zeros(4, dtype=torch.bool), torch.ones(4), torch.ones(4, dtype=torch.bool), 0.01)
        loss.backward()
        assert loss.item() == 0
        assert (depth.grad == 0).all()

    @pytest.mark.parametrize("bad", [float("nan"), float("inf"), 0.0, -1.0])
    def test_bad_prior_pixels_outside_the_mask_never_leak(self, bad: float) -> None:
        depth = torch.tensor([1.0, 2.0], requires_grad=True)
        verified = torch.tensor([True, False])
        loss = depth_loss(depth, torch.ones(2, dtype=torch.bool), tensor(1.1, bad), verified, 0.01)
        loss.backward()
        assert torch.isfinite(loss)
        assert torch.isfinite(depth.grad).all()

    @pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
    def test_does_not_depend_on_the_scale_of_the_scene(self, scale: float) -> None:
        mask = torch.ones(2, dtype=torch.bool)
        reference = depth_loss(tensor(1.1, 3.0), mask, tensor(1.0, 4.0), mask, 0.01)
        scaled = depth_loss(tensor(1.1, 3.0) * scale, mask, tensor(1.0, 4.0) * scale, mask, 0.01)
        torch.testing.assert_close(scaled, reference, rtol=2e-5, atol=0)

    def test_depths_a_billion_apart_in_one_image_weigh_alike(self) -> None:
        mask = torch.ones(2, dtype=torch.bool)
        loss = depth_loss(tensor(1.1e-3, 1.1e6), mask, tensor(1e-3, 1e6), mask, 0.01)
        torch.testing.assert_close(loss, charbonnier(tensor(0.1), 0.01).squeeze(), rtol=1e-4, atol=0)


class TestPixelDepthLoss:
    """The fast form that the hook uses is the paper's formula, value and gradient."""

    @staticmethod
    def maps(
        seed: int, shape: tuple[int, int] = (7, 9)
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        depth_sum, alpha, prior, chance = torch.rand(4, *shape, generator=generator, dtype=torch.float64)
        return depth_sum * 3, alpha, prior + 0.5, chance < 0.4

    @given(st.integers(0, 10_000))
    @settings(max_examples=50, deadline=None)
    def test_equals_the_composed_formula_with_its_gradient(self, seed: int) -> None:
        depth_sum, alpha, prior, verified = self.maps(seed)
        pixels = known(prior, verified)
        gradients = []
        for fast in (False, True):
            z, a = depth_sum.clone().requires_grad_(), alpha.clone().requires_grad_()
            if fast:
                loss = pixel_depth_loss(z, a, pixels, PAPER)
            else:
                depth, valid = rendered_depth(z, a, 0.5)
                loss = depth_loss(depth, valid, prior, verified, 0.01)
            (3 * loss).backward()
            gradients.append((loss.detach(), z.grad, a.grad))
        for composed, closed in zip(*gradients, strict=True):
            torch.testing.assert_close(closed, composed, rtol=1e-7, atol=1e-12)

    @pytest.mark.parametrize("opaque", [0.05, 3.0])
    def test_what_near_pixels_let_through_is_added_with_its_gradient(self, opaque: float) -> None:
        depth_sum, alpha, prior, verified = self.maps(2)
        alpha = torch.where((alpha - 0.5).abs() < 0.01, 0.6, alpha)
        pixels = known(prior, verified)
        far = torch.arange(len(pixels.index)) % 3 == 0
        pixels = replace(pixels, far=far)
        config = replace(PAPER, opaque=opaque)
        through = 1 - alpha.flatten()[pixels.index[~far]]
        added = pixel_depth_loss(depth_sum, alpha, pixels, config) - pixel_depth_loss(depth_sum, alpha, pixels, PAPER)
        torch.testing.assert_close(added, opaque * through.mean())
        inputs = (depth_sum.requires_grad_(), alpha.requires_grad_())
        assert torch.autograd.gradcheck(lambda z, a: pixel_depth_loss(z, a, pixels, config), inputs)

    def test_where_all_is_far_nothing_is_let_through_wrongly(self) -> None:
        depth_sum, alpha, prior, verified = self.maps(3)
        pixels = known(prior, verified)
        pixels = replace(pixels, far=torch.ones_like(pixels.far))
        losses = [pixel_depth_loss(depth_sum, alpha, pixels, replace(PAPER, opaque=o)) for o in (0.0, 1.0)]
        assert torch.equal(*losses)

    def test_gradcheck(self) -> None:
        depth_sum, alpha, prior, verified = self.maps(1)
        alpha = torch.where((alpha - 0.5).abs() < 0.01, 0.6, alpha)  # away from the step at tau_v
        pixels = known(prior, verified)
        inputs = (depth_sum.requires_grad_(), alpha.requires_grad_())
        assert torch.autograd.gradcheck(lambda z, a: pixel_depth_loss(z, a, pixels, PAPER), inputs)

    def test_is_finite_where_nothing_is_rendered(self) -> None:
        z, a = torch.zeros(1, 2, requires_grad=True), torch.zeros(1, 2, requires_grad=True)
        pixels = known(tensor(1e-3, 1e6)[None], torch.ones(1, 2, dtype=torch.bool))
        loss = pixel_depth_loss(z, a, pixels, PAPER)
        loss.backward()
        assert loss == 0
        assert not z.grad.any()
        assert not a.grad.any()

"""Verified-depth supervision: the penalty, the paper's loss, and the loss of a render by torch and by the kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from d2_plugin.hooks import depth_loss as module
from d2_plugin.hooks import native_depth_loss
from d2_plugin.hooks.depth_loss import DepthLossConfig, charbonnier, depth_loss, supervision
from d2_plugin.hooks.prior import KnownMaps, PriorLoader
from d2_plugin.protocol import DepthPrior, Label, View

PAPER = DepthLossConfig(tau_v=0.5, epsilon=0.01, opaque=0)
LABELS = (Label.EMPTY, Label.MONO, Label.VERIFIED, Label.CONFLICT, Label.AGREED, Label.FAR)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values)


class TestThePapersLoss:
    def test_counts_only_pixels_that_are_trusted_and_validly_rendered(self) -> None:
        depth, prior = tensor(2.0, 2.0, 2.0), tensor(1.0, 4.0, 8.0)
        valid, verified = torch.tensor([True, True, False]), torch.tensor([True, False, True])
        expected = charbonnier(tensor(1.0), 0.01).squeeze()
        torch.testing.assert_close(depth_loss(depth, valid, prior, verified, 0.01), expected)


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


def render_of(height: int, width: int, seed: int = 10) -> tuple[Tensor, Tensor]:
    """Depth sum and alpha of a render; no alpha lies within rounding of tau_v."""
    g = torch.Generator().manual_seed(seed)
    alpha = torch.rand(height, width, generator=g)
    alpha = torch.where((alpha - 0.5).abs() < 0.01, 0.6, alpha)
    return alpha * (1 + 9 * torch.rand(height, width, generator=g)), alpha


def loss_and_gradients(
    render: tuple[Tensor, Tensor],
    prior: DepthPrior,
    dtype: torch.dtype = torch.float32,
    config: DepthLossConfig = DepthLossConfig(),  # noqa: B008  a frozen value
    factor: float = 1.0,
) -> list[Tensor]:
    """In float32 by the kernel where there is a compiler, in float64 by torch."""
    leaves = [part.to(dtype, copy=True).requires_grad_() for part in render]
    sigma = None if prior.sigma is None else prior.sigma.to(dtype)
    known = KnownMaps.of(prior._replace(depth=prior.depth.to(dtype), sigma=sigma))
    loss = supervision(*leaves, known, config, factor)
    return [loss.detach(), *torch.autograd.grad(loss, leaves)]


class TestSupervision:
    """What a render costs: the paper's formula over all maps, and what lets light through."""

    @pytest.mark.parametrize("opaque", [0.0, 3.0])
    def test_gradcheck(self, opaque: float) -> None:
        prior, config = prior_of(1, 7, 9), replace(PAPER, opaque=opaque)
        known = KnownMaps.of(prior._replace(depth=prior.depth.double(), sigma=prior.sigma.double()))
        inputs = [part.double().requires_grad_() for part in render_of(7, 9)]
        assert torch.autograd.gradcheck(lambda z, a: supervision(z, a, known, config), inputs)

    def test_what_near_pixels_let_through_is_added_and_far_ones_let_through_nothing_wrongly(self) -> None:
        prior, render = prior_of(2, 7, 9), render_of(7, 9)
        near = KnownMaps.of(prior).kind == 1
        with_term, without = (loss_and_gradients(render, prior, config=replace(PAPER, opaque=o))[0] for o in (3.0, 0.0))
        torch.testing.assert_close(with_term - without, 3 * (1 - render[1][near]).mean())
        far = prior_of(2, 7, 9, (Label.FAR,))
        losses = [loss_and_gradients(render, far, config=replace(PAPER, opaque=o))[0] for o in (3.0, 0.0)]
        assert torch.equal(*losses)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_a_render_that_covers_nothing_has_the_opaque_term_alone(self, dtype: torch.dtype) -> None:
        prior, nothing = prior_of(0, 20, 30), torch.zeros(20, 30)
        loss, by_depth, by_alpha = loss_and_gradients((nothing, nothing), prior, dtype)
        near = KnownMaps.of(prior).kind == 1
        assert loss.item() == pytest.approx(DepthLossConfig().opaque)
        assert not by_depth.any()
        torch.testing.assert_close(by_alpha.float(), torch.where(near, -DepthLossConfig().opaque / near.sum(), 0.0))


@pytest.fixture
def compiled() -> None:
    if native_depth_loss.library() is None:
        pytest.skip("there is no C++ compiler")


@pytest.mark.usefixtures("compiled")
class TestKernel:
    @pytest.mark.parametrize("size", [(1, 1), (1, 17), (3, 5), (61, 67), (90, 130)])
    @pytest.mark.parametrize("paper", [False, True])
    def test_equals_torch_in_float64(self, size: tuple[int, int], paper: bool) -> None:
        for seed in range(4):
            prior, render = prior_of(seed, *size, paper=paper), render_of(*size, seed + 10)
            known = KnownMaps.of(prior)
            if known.near + known.far:
                found, exact = (
                    loss_and_gradients(render, prior, t, factor=0.2) for t in (torch.float32, torch.float64)
                )
                for one, other in zip(found, exact, strict=True):
                    assert one.dtype == torch.float32
                    assert (one - other).norm() <= 3e-6 * other.norm(), f"seed {seed}"
                for slope in found[1:]:
                    assert not slope[known.kind == 0].any()

    @pytest.mark.parametrize("scale", [1e-20, 1e20, 1e30])
    def test_depths_beyond_the_range_of_squares_are_as_in_torch(
        self, scale: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        prior, (depth_sum, alpha) = prior_of(5, 20, 30), render_of(20, 30)
        native = loss_and_gradients((scale * depth_sum, alpha), prior)
        monkeypatch.setattr(module, "can_compare", lambda *parts: False)
        plain = loss_and_gradients((scale * depth_sum, alpha), prior)
        torch.testing.assert_close(native, plain, rtol=1e-4, atol=1e-30)
        assert all(part.isfinite().all() for part in native)

    @pytest.mark.parametrize("epsilon", [1e-6, 1e-3, 1e6])
    @pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e30])
    def test_spreads_beyond_the_range_of_squares_are_as_in_float64(self, epsilon: float, sigma: float) -> None:
        prior = prior_of(3, 20, 30, (Label.VERIFIED, Label.MONO))._replace(sigma=torch.full((20, 30), sigma))
        config = DepthLossConfig(epsilon=epsilon)
        found, exact = (loss_and_gradients(render_of(20, 30), prior, t, config) for t in (torch.float32, torch.float64))
        for one, other in zip(found, exact, strict=True):
            torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-12)

    def test_the_number_of_threads_changes_no_bit(self, same_for_any_threads: Callable) -> None:
        same_for_any_threads(lambda: loss_and_gradients(render_of(90, 400), prior_of(0, 90, 400)))

    def test_nan_in_a_known_pixel_shows_in_the_loss(self) -> None:
        prior, (depth_sum, alpha) = prior_of(0, 20, 30), render_of(20, 30)
        alpha[tuple(torch.nonzero(KnownMaps.of(prior).kind == 1)[3])] = math.nan
        assert loss_and_gradients((depth_sum, alpha), prior)[0].isnan()

    def test_backward_twice_adds_the_same_again_and_second_derivatives_are_refused(self) -> None:
        leaves, known = [part.requires_grad_() for part in render_of(20, 30)], KnownMaps.of(prior_of(0, 20, 30))
        loss = supervision(*leaves, known, DepthLossConfig())
        loss.backward(retain_graph=True)
        once = [leaf.grad.clone() for leaf in leaves]
        (loss + leaves[1].sum()).backward(retain_graph=True)
        (2 * loss).backward()
        torch.testing.assert_close(leaves[0].grad, 4 * once[0])
        torch.testing.assert_close(leaves[1].grad, 4 * once[1] + 1)
        loss = supervision(*leaves, known, DepthLossConfig())
        (slope,) = torch.autograd.grad(loss, leaves[:1], create_graph=True)
        with pytest.raises(RuntimeError, match="once_differentiable|does not require grad"):
            slope.sum().backward()


@pytest.mark.parametrize("count", [1, 3])
def test_the_hook_adds_the_weighted_mean_of_a_batch(count: int) -> None:
    priors = [prior_of(seed, 20, 30) for seed in range(count)]
    renders = [[part.requires_grad_() for part in render_of(20, 30, seed)] for seed in range(count)]
    backbone = SimpleNamespace(rendered_depth=lambda view: renders[view])
    prior = SimpleNamespace(known=lambda view: KnownMaps.of(priors[view]) if view < count else None)
    hook = module.DepthLoss(DepthLossConfig(weight=0.7))
    term = hook.loss(SimpleNamespace(backbone=backbone, prior=prior, views=range(count + 1)))
    alone = [loss_and_gradients((z.detach(), a.detach()), prior) for (z, a), prior in zip(renders, priors, strict=True)]
    torch.testing.assert_close(term.detach(), 0.7 * torch.stack([loss for loss, *_ in alone]).mean())
    for render, (_, *slopes) in zip(renders, alone, strict=True):
        for one, other in zip(torch.autograd.grad(term, render, retain_graph=True), slopes, strict=True):
            torch.testing.assert_close(one, 0.7 / count * other)


class TestLoader:
    def test_priors_stay_in_memory_as_long_as_they_fit(self) -> None:
        prior, reads = prior_of(0, 360, 640), []
        store = SimpleNamespace(prior=lambda camera, frame: reads.append(frame) or prior)
        views = [View("a", frame, 0.0, torch.eye(4), torch.eye(3), 640, 360) for frame in range(8)]
        for memory, expected in ((32, 8), (16, 16)):  # a view takes 3.2 MB
            reads.clear()
            loader = PriorLoader(store, memory)
            for view in (*views, *views):
                assert loader.known(view).near > 0
            assert len(reads) == expected

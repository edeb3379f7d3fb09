"""Verified-depth supervision: the paper's loss, what sigma and far pixels add, by torch and by the kernel."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from d2_plugin.hooks import depth_loss as module
from d2_plugin.hooks import prior as loading
from d2_plugin.hooks.densify import Densify, DensifyConfig, rendered_depth, under_reconstructed
from d2_plugin.hooks.depth_loss import DepthLossConfig, supervision
from d2_plugin.hooks.prior import FAR, JUDGES, KnownMaps, PriorLoader
from d2_plugin.protocol import DepthPrior, Label, View

PAPER = DepthLossConfig(tau_v=0.5, epsilon=0.01, sigma_full=0.05, opaque=0)
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


class TestRender:
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

    def test_a_render_of_16_bits_counts_more_pixels_than_16_bits_can(self) -> None:
        prior, render = prior_of(0, 300, 400, (Label.VERIFIED,), paper=True), render_of(300, 400)
        known, config = KnownMaps.of(prior), replace(PAPER, tau_v=0)
        half, full = (supervision(*(part.to(t) for part in render), known, config) for t in (torch.half, torch.float))
        torch.testing.assert_close(half, full, rtol=1e-2, atol=0)


@pytest.mark.usefixtures("compiler")
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
    def test_depths_beyond_the_range_of_squares_are_as_in_torch(self, scale: float, monkeypatch) -> None:
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


def test_the_hook_adds_the_weighted_mean_of_a_batch() -> None:
    count = 3
    priors = [prior_of(seed, 20, 30) for seed in range(count)]
    renders = [[part.requires_grad_() for part in render_of(20, 30, seed)] for seed in range(count)]
    backbone = SimpleNamespace(rendered_depth=lambda view: renders[view.frame])
    prior = SimpleNamespace(known=lambda view: KnownMaps.of(priors[view.frame]) if view.frame < count else None)
    views = [View("a", frame, 0.0, torch.eye(4), torch.eye(3), 30, 20) for frame in range(count + 1)]
    hook = module.DepthLoss(DepthLossConfig(weight=0.7))
    term = hook.loss(SimpleNamespace(backbone=backbone, prior=prior, views=views))
    alone = [loss_and_gradients((z.detach(), a.detach()), prior) for (z, a), prior in zip(renders, priors, strict=True)]
    torch.testing.assert_close(term.detach(), 0.7 * torch.stack([loss for loss, *_ in alone]).mean())
    for render, (_, *slopes) in zip(renders, alone, strict=True):
        for one, other in zip(torch.autograd.grad(term, render, retain_graph=True), slopes, strict=True):
            torch.testing.assert_close(one, 0.7 / count * other)


@pytest.fixture(autouse=True)
def single_far_pixels_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here far pixels lie alone, all outline; the last test shows what that leaves out."""
    monkeypatch.setattr(loading, "OUTLINE", 0)


def loader_of(prior: DepthPrior) -> tuple[PriorLoader, View]:
    """A loader whose store has one prior, and the view that it belongs to."""
    height, width = prior.depth.shape
    view = View("a", 0, 0.0, torch.eye(4), torch.eye(3), width, height)
    return PriorLoader(SimpleNamespace(prior=lambda camera, frame: prior)), view


def known(prior: DepthPrior) -> KnownMaps | None:
    loader, view = loader_of(prior)
    return loader.known(view)


def papers_sigma(labels: Tensor) -> Tensor:
    """0 at verified pixels and infinite elsewhere."""
    return torch.where(labels == Label.VERIFIED, 0.0, torch.inf)


def gradients(loss: Tensor, *inputs: Tensor) -> list[Tensor]:
    return [loss.detach(), *torch.autograd.grad(loss, inputs)]


class TestThePaperIsASpecialCase:
    """Its equations, written out; AGREED and FAR are additions to it and do not occur."""

    @staticmethod
    def maps(seed: int) -> tuple[Tensor, Tensor, DepthPrior]:
        prior = prior_of(seed, 7, 9, (Label.EMPTY, Label.MONO, Label.VERIFIED, Label.CONFLICT), paper=True)
        return *(part.double() for part in render_of(7, 9, seed + 1)), prior._replace(depth=prior.depth.double())

    @given(st.integers(0, 10_000), st.booleans())
    @settings(max_examples=30)
    def test_loss_and_gradient(self, seed: int, with_sigma: bool) -> None:
        """L = mean over Omega^v and M^r of sqrt(r^2 + e^2) - e, r = (D_hat - D*) / (D* + eps)."""
        depth_sum, alpha, prior = self.maps(seed)
        z, a = depth_sum.requires_grad_(), alpha.requires_grad_()
        counted = (prior.labels == Label.VERIFIED) & (a > 0.5)
        residual = (z[counted] / (a[counted] + 1e-8) - prior.depth[counted]) / (prior.depth[counted] + 1e-8)
        paper = (torch.sqrt(residual**2 + 0.01**2) - 0.01).sum() / (counted.sum() + 1e-8)
        pixels = known(prior._replace(sigma=papers_sigma(prior.labels)) if with_sigma else prior)
        found = supervision(z, a, pixels, PAPER)
        for ours, theirs in zip(gradients(found, z, a), gradients(paper, z, a), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-12)

    @given(st.integers(0, 10_000), st.booleans())
    @settings(max_examples=30)
    def test_region(self, seed: int, with_sigma: bool) -> None:
        """U = Omega^p and (not M^r, or |D_hat - D*| / (D* + eps) > tau_u), with a threshold of its own for mono-only"""
        depth_sum, alpha, prior = self.maps(seed)
        config = DensifyConfig()
        verified, mono = prior.labels == Label.VERIFIED, prior.labels == Label.MONO
        off = (depth_sum / (alpha + 1e-8) - prior.depth).abs() / (prior.depth + 1e-8)
        wrong = (verified & (off > config.tau_u)) | (mono & (off > config.tau_u_mono))
        paper = ((verified | mono) & ~(alpha > config.tau_v)) | wrong
        if with_sigma:
            prior = prior._replace(sigma=papers_sigma(prior.labels))
        assert torch.equal(region(prior, depth_sum, alpha, config), paper)
        assert paper.any()


def region(prior: DepthPrior, depth_sum: Tensor, alpha: Tensor, config: DensifyConfig) -> Tensor:
    """U of a render, as the hook finds it."""
    depth, valid = rendered_depth(depth_sum, alpha, config.tau_v)
    return under_reconstructed(depth, valid, prior.depth, prior.support, Densify(config)._tau_u(prior))


class TestSupervision:
    def test_a_far_pixel_pulls_nothing_from_behind_and_pushes_what_is_in_front(self) -> None:
        labels = torch.full((1, 3), int(Label.FAR), dtype=torch.uint8)
        pixels = known(DepthPrior(torch.full((1, 3), 10.0), labels, sigma=torch.full((1, 3), torch.inf)))
        a = torch.full((1, 3), 0.8, requires_grad=True)
        z = (torch.tensor([[4.0, 10.0, 400.0]]) * 0.8).requires_grad_()  # in front, at the bound, behind
        loss = supervision(z, a, pixels, PAPER)
        _, by_sum, by_alpha = gradients(loss, z, a)
        assert by_sum[0, 0] < 0 < by_alpha[0, 0], "a step of descent must deepen it and thin it"
        assert by_sum[0, 2] == by_alpha[0, 2] == 0
        assert by_sum[0, 1].abs() < 1e-4
        assert loss.item() == pytest.approx((0.36 + 0.01**2) ** 0.5 / 3 - 0.01 / 3, rel=1e-4)

    def test_weight_falls_as_one_over_sigma(self) -> None:
        sigma = torch.tensor([[0.0, 0.01, 0.05, 0.1, 0.2, 1.0]]).double()
        prior = DepthPrior(torch.ones(1, 6).double(), torch.full((1, 6), int(Label.MONO), dtype=torch.uint8))
        a = torch.ones(1, 6).double()
        z = (1e5 * a).requires_grad_()  # so far off that the penalty is linear
        pixels = known(prior._replace(sigma=sigma))
        _, slope = gradients(supervision(z, a, pixels, PAPER), z)
        expected = torch.tensor([1, 1, 1, 0.5, 0.25, 0.05]).double()
        torch.testing.assert_close(slope[0] / slope[0, 0], expected, rtol=1e-6, atol=0)

    def test_within_sigma_the_penalty_is_flat(self) -> None:
        """At a residual of 1 %, sigma 10 % pulls a tenth of what its weight allows; sigma 0 pulls .7 of it."""
        slopes = []
        for sigma in (0.0, 0.1):
            prior = DepthPrior(torch.ones(1, 1), torch.ones(1, 1).byte(), sigma=torch.full((1, 1), sigma))
            z = torch.full((1, 1), 1.01, requires_grad=True)
            slopes.append(gradients(supervision(z, torch.ones(1, 1), known(prior), PAPER), z)[1].item())
        assert slopes == pytest.approx([0.5**0.5, 0.1], rel=0.01)

    def test_infinite_sigma_is_not_in_the_loss_but_proposes(self) -> None:
        labels = torch.full((1, 3), int(Label.MONO), dtype=torch.uint8)
        prior = DepthPrior(torch.ones(1, 3), labels, sigma=torch.full((1, 3), torch.inf))
        assert known(prior) is None
        config = DensifyConfig(tau_u=0.1, tau_u_mono=0.2)
        found = region(prior, torch.tensor([[1.15, 1.25, 0.0]]), torch.tensor([[1.0, 1.0, 0.0]]), config)
        assert found.tolist() == [[False, True, True]]

    def test_a_finite_sigma_widens_the_threshold_of_insertion_and_never_narrows_it(self) -> None:
        sigma = torch.tensor([[0.0, 0.04, 0.1, 0.1]])
        labels = torch.tensor([[Label.VERIFIED, Label.MONO, Label.MONO, Label.FAR]], dtype=torch.uint8)
        prior = DepthPrior(torch.ones(1, 4), labels, sigma=sigma)
        config = DensifyConfig(tau_u=0.1)
        off = torch.tensor([[1.11, 1.11, 1.24, 1.5]])
        assert region(prior, off, torch.ones(1, 4), config).tolist() == [[True, True, False, False]]
        assert region(prior, off + 0.02, torch.ones(1, 4), config).tolist() == [[True, True, True, False]]
        assert not region(prior, torch.zeros(1, 4), torch.zeros(1, 4), config)[0, 3], "nothing is inserted far away"


def test_pixels_judge_where_sigma_is_small_whatever_their_label() -> None:
    labels = torch.tensor([[Label.VERIFIED, Label.VERIFIED, Label.MONO, Label.FAR, Label.CONFLICT, Label.MONO]])
    sigma = torch.tensor([[0.0, 2 * JUDGES, JUDGES, 0.0, 0.0, 0.0]])
    depth = torch.tensor([[1.0, 1, 1, 1, 0, torch.nan]])
    loader, view = loader_of(DepthPrior(depth, labels.byte(), sigma=sigma))
    assert loader(view).reliability.tolist() == [[1, 0, 1, 0, 0, 0]]
    assert loader.known(view).kind.tolist() == [[1, 1, 1, FAR, 0, 0]]


class TestStiff:
    def test_everything_extreme_in_one_view(self) -> None:
        """sigma 0 to 1e30, depths 1e-3 to 1e6, alpha tau_v itself or an ulp above, NaN and infinity in the prior."""
        nan, inf = torch.nan, torch.inf
        depth = torch.tensor([[1e-3, 1e6, 1e-3, 1e6, 1.0, 1.0, nan, inf, 1.0, 1e6]])
        sigma = torch.tensor([[0.0, 1e-4, 1.0, 0.0, 1e30, nan, 0.0, 0.0, 0.0, 0.0]])
        labels = torch.full((1, 10), int(Label.VERIFIED), dtype=torch.uint8)
        labels[0, 9] = Label.FAR
        pixels = known(DepthPrior(depth, labels, sigma=sigma))
        assert pixels.kind.flatten().nonzero().flatten().tolist() == [0, 1, 2, 3, 4, 8, 9]
        above = torch.nextafter(torch.tensor(0.5), torch.tensor(1.0)).item()
        a = torch.tensor([[above, 1.0, 1.0, above, 1.0, 1.0, 1.0, 1.0, 0.5, 1.0]]).requires_grad_()
        z = torch.tensor([[1e6, 1e-3, 1e6, 1e6, 1.0, 1.0, 1.0, 1.0, 7.0, 1e-3]]).requires_grad_()
        loss, by_sum, by_alpha = gradients(supervision(z, a, pixels, PAPER), z, a)
        assert loss.isfinite()
        assert by_sum.isfinite().all()
        assert by_alpha.isfinite().all()
        assert not by_sum[0, 5:9].any(), "no depth, no sigma, or alpha no more than tau_v"
        assert by_sum[0, [0, 2, 3]].gt(0).all()
        assert by_sum[0, [1, 9]].lt(0).all()


def test_the_outline_of_a_sky_says_nothing_and_the_rim_of_the_image_is_no_outline(monkeypatch) -> None:
    monkeypatch.setattr(loading, "OUTLINE", 2)
    labels = torch.full((10, 12), int(Label.VERIFIED), dtype=torch.uint8)
    labels[:6] = int(Label.FAR)
    sigma = torch.where(labels == Label.FAR, torch.inf, 0.01)
    found = known(DepthPrior(torch.full((10, 12), 5.0), labels, None, sigma))
    rows = (found.kind == FAR).any(1), (found.kind == 1).any(1)
    assert [row.nonzero().flatten().tolist() for row in rows] == [[0, 1, 2, 3], [6, 7, 8, 9]]

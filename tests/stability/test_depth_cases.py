"""Stiff and extreme cases around rendered depth, starting points and images, numbered as in the list of cases that
broke other codebases; those of the rasterizer, the slice, alignment and stereo have files of their own."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from d2_plugin.backbones.starting import nearest_neighbour_scales
from d2_plugin.hooks.rendered_depth import EPSILON, rendered_depth

TAU_V = 0.5
both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


# ---------------------------------------------------------------- Gaussians that are not there


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

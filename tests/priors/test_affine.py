"""The positive-scale Charbonnier fit: right, certified, and indifferent to units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.monocular.affine import AffineFit, charbonnier, fit_affine


def objective(scale: float, shift: float, x: np.ndarray, y: np.ndarray, w: np.ndarray, epsilon: float) -> float:
    residual = w * (scale * x + shift - y)
    return float(np.sum(np.sqrt(residual**2 + epsilon**2) - epsilon))


def line(n: int, outliers: float = 0.3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """y = 2 x + .5 with noise .01 and a share of uniform outliers."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(1, 6, n)
    x = (y - 0.5) / 2 + rng.normal(0, 0.005, n)
    wrong = rng.random(n) < outliers
    return x, np.where(wrong, rng.uniform(0.5, 12, n), y)


def independent_minimum(x: np.ndarray, y: np.ndarray, epsilon: float) -> float:
    """The minimum over scale >= 0 by nested golden sections: slow, and nothing in common with Newton."""

    def golden(f, low: float, high: float) -> float:
        ratio = (np.sqrt(5) - 1) / 2
        for _ in range(80):
            a, b = high - ratio * (high - low), low + ratio * (high - low)
            low, high = (low, b) if f(a) < f(b) else (a, high)
        return f((low + high) / 2)

    one = np.ones_like(x)

    def best_shift(scale: float) -> float:
        rest = y - scale * x
        return golden(lambda shift: objective(scale, shift, x, y, one, epsilon), rest.min(), rest.max())

    return golden(best_shift, 0.0, 10.0)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("epsilon", [0.3, 0.01])
def test_the_minimum_is_that_of_an_independent_solver(outliers: float, epsilon: float) -> None:
    x, y = line(200, outliers)
    fit = fit_affine(x, y, epsilon=epsilon)
    reference = independent_minimum(x, y, epsilon)
    assert fit.objective == pytest.approx(reference, rel=1e-8)
    assert fit.objective <= reference * (1 + 1e-10)


def test_at_the_boundary_the_scale_wants_to_be_negative_and_the_shift_is_best() -> None:
    x, y = line(2000, 0.0)
    fit = fit_affine(-x, y, epsilon=0.05, tolerance=1e-15)
    assert fit.boundary
    assert fit.scale == 0
    slope = (fit.shift - y) / np.sqrt((fit.shift - y) ** 2 + 0.05**2)
    assert abs(slope.sum()) < 1e-6 * len(x)
    assert (slope * -x).sum() >= 0


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 60), st.integers(0, 10**6), st.floats(0, 1), st.sampled_from([1e-6, 1e-3, 0.1, 1.0]), st.booleans()
)
def test_the_gap_bounds_the_distance_to_every_other_line(
    n: int, seed: int, outliers: float, epsilon: float, weighted: bool
) -> None:
    x, y = line(n, outliers, seed)
    rng = np.random.default_rng(seed)
    w = rng.uniform(0.1, 3, n) if weighted else np.ones(n)
    # Few iterations on purpose: the certificate must be true of any iterate, not only of the optimum.
    fit = fit_affine(x, y, w, epsilon=epsilon, max_iterations=int(rng.integers(0, 4)))
    bound = fit.objective - fit.gap * max(fit.objective, 1e-6 * n * epsilon)
    best = fit_affine(x, y, w, epsilon=epsilon, tolerance=1e-13)
    candidates = [(best.scale, best.shift), *zip(rng.uniform(0, 4, 30), rng.uniform(-2, 5, 30))]
    for scale, shift in candidates:
        # sums of weighted residuals round at about 1e-12 of their value
        assert objective(scale, shift, x, y, w, epsilon) >= bound - 1e-11 * (1 + abs(bound)) * n


@settings(max_examples=40, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_units_of_either_depth_do_not_matter(x_unit: float, x_origin: float, y_unit: float) -> None:
    x, y = line(300, 0.2)
    plain = fit_affine(x, y, epsilon=0.03)
    other = fit_affine(x * x_unit + x_origin, y * y_unit, epsilon=0.03 * y_unit)
    assert other.gap <= 1e-8
    predicted = (other.scale * (x * x_unit + x_origin) + other.shift) / y_unit
    # The offset costs the digits that it takes from x itself.
    lost = np.finfo(float).eps * (abs(x_origin) / x_unit + 1)
    np.testing.assert_allclose(predicted, plain.scale * x + plain.shift, atol=1e-5 + 100 * lost)


def test_non_finite_points_and_points_without_weight_are_ignored() -> None:
    x, y = line(500, 0.1)
    weights = np.ones(500)
    kept = np.ones(500, bool)
    kept[::7] = kept[::5] = kept[::11] = False
    clean = fit_affine(x[kept], y[kept], epsilon=0.05)
    x[::7], y[::5], weights[::11] = np.nan, np.inf, 0
    assert fit_affine(x, y, weights, epsilon=0.05) == clean


def test_the_standard_error_is_that_of_repeated_draws() -> None:
    def draw(seed: int) -> AffineFit:
        rng = np.random.default_rng(seed)
        x = rng.uniform(0, 1, 400)
        return fit_affine(x, 2 * x + 0.5 + rng.normal(0, 0.1, 400), epsilon=0.05)

    fits = [draw(seed) for seed in range(200)]
    spread = np.std([fit.scale for fit in fits])
    assert np.mean([fit.scale_error for fit in fits]) == pytest.approx(spread, rel=0.15)


def test_the_penalty_keeps_its_digits_at_both_ends() -> None:
    assert charbonnier(np.array([0.0]), 0.1)[0] == 0
    assert charbonnier(np.array([1e-12]), 0.1)[0] == pytest.approx(5e-24, rel=1e-9)
    assert charbonnier(np.array([1e200]), 0.1)[0] == pytest.approx(1e200)

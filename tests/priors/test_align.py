"""Alignment of monocular depth: the line of least certified cost, what is refused, and stiff cases (43, 45)."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from refusals import refuses
from scipy.optimize import minimize

from d2_plugin.priors.monocular import align as module
from d2_plugin.priors.monocular.affine import AffineFit, fit_affine
from d2_plugin.priors.monocular.align import Alignment, AlignStatus, align, aligned_depth, not_aligned, rank_correlation
from d2_plugin.priors.settings import AlignSettings

SHAPE = (90, 120)


def depths(seed: int = 0) -> np.ndarray:
    """A slanted scene from 2 to 7 with some relief."""
    rng = np.random.default_rng(seed)
    ramp = np.linspace(2, 6, SHAPE[1])[None, :] + np.zeros((SHAPE[0], 1))
    return ramp + rng.uniform(0, 1, SHAPE)


def anchors(depth: np.ndarray, share: float = 0.3, noise: float = 0.002, seed: int = 1) -> np.ndarray:
    """Geometric depth at a share of the pixels, 0 elsewhere."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(SHAPE) < share, depth * (1 + rng.normal(0, noise, SHAPE)), 0)


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_a_line_is_fitted_to_inverse_depth_of_relative_maps_and_as_in_the_paper_to_metric_ones(kind: str) -> None:
    depth, scale, shift = depths(), *{"relative": (0.3, 0.05), "metric": (1.7, 0.4)}[kind]
    mono = ((1 / depth if kind == "relative" else depth) - shift) / scale  # what such a network returns
    settings = AlignSettings(residual="relative" if kind == "relative" else "absolute")
    alignment = align(mono, anchors(depth), kind=kind, settings=settings)
    assert alignment.status is AlignStatus.OK
    assert (alignment.scale, alignment.shift) == pytest.approx((scale, shift), rel=5e-3)
    np.testing.assert_allclose(aligned_depth(mono, alignment, 100.0), depth, rtol=2e-3)


def test_zeros_of_a_saturated_network_are_neither_fitted_nor_given_a_depth() -> None:
    depth = depths()
    mono = np.maximum((1 / depth - 0.2) / 0.3, 0)  # beyond a depth of 5 a ReLU returns zero
    alignment = align(mono, anchors(depth), kind="relative", settings=AlignSettings())
    assert (alignment.scale, alignment.shift) == pytest.approx((0.3, 0.2), rel=5e-3)
    np.testing.assert_array_equal(aligned_depth(mono, alignment, 100.0) > 0, mono > 0)


def test_subsampling_changes_the_aligned_depth_by_less_than_a_thousandth(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.tile(depths(), (4, 4))
    mono = (1 / depth - 0.05) / 0.3 * (1 + np.random.default_rng(3).normal(0, 0.02, depth.shape))
    maps = []
    for most in (10**6, 20_000):
        monkeypatch.setattr(module, "MAX_ANCHORS", most)
        maps.append(aligned_depth(mono, align(mono, depth, kind="relative", settings=AlignSettings()), 100.0))
    assert np.abs(maps[1] / maps[0] - 1).max() < 1e-3


def test_depth_that_is_not_positive_is_left_empty_and_never_clamped() -> None:
    alignment = Alignment(AlignStatus.OK, "relative", scale=1.0, shift=-0.5)
    out = aligned_depth(np.array([[0.2, 0.5, 0.501, 0.6, np.nan, np.inf]]), alignment, z_far=100.0)
    np.testing.assert_allclose(out, [[0, 0, 0, 10, 0, 0]], rtol=1e-6)
    assert out.dtype == np.float32
    metric = Alignment(AlignStatus.OK, "metric", scale=2.0, shift=-1.0)
    np.testing.assert_allclose(aligned_depth(np.array([[0.5, 0.4, 3, 60]]), metric, 100.0), [[0, 0, 5, 0]])


def test_an_unaligned_map_is_used_as_it_is() -> None:
    mono = np.array([[0.5, 0.25]])
    np.testing.assert_allclose(aligned_depth(mono, not_aligned("relative"), 100.0), [[2, 4]])
    np.testing.assert_allclose(aligned_depth(mono, not_aligned("metric"), 100.0), mono)


def test_the_rank_correlation_is_spearmans_also_of_equal_values() -> None:
    x, y = np.array([0.1, 2, 2, 9e9]), np.array([1, 7, 3, 8.0])  # ranks 1, 2.5, 2.5, 4 and 1, 3, 2, 4
    assert rank_correlation(x, y) == pytest.approx(4.5 / np.sqrt(4.5 * 5))
    assert rank_correlation(x, np.ones(4)) == 0


def test_mistakes_are_told_in_one_sentence() -> None:
    refuses("did you mean 'absolute'", AlignSettings, residual="absolut")


def objective(scale: float, shift: float, x: np.ndarray, y: np.ndarray, w: np.ndarray, epsilon: float) -> float:
    residual = w * (scale * x + shift - y)
    return float(np.sum(np.sqrt(residual**2 + epsilon**2) - epsilon))


def line(n: int = 20_000, outliers: float = 0, seed: int = 0, noise: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """y = 2 x + .5 with noise and a share of uniform outliers."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(1, 6, n)
    x = (y - 0.5) / 2 + rng.normal(0, noise / 2, n)
    wrong = rng.random(n) < outliers
    return x, np.where(wrong, rng.uniform(0.5, 12, n), y)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("epsilon", [0.3, 0.01])
def test_the_minimum_is_that_of_an_independent_solver(outliers: float, epsilon: float) -> None:
    x, y = line(200, outliers)
    fit = fit_affine(x, y, epsilon=epsilon)
    found = minimize(lambda at: objective(*at, x, y, np.ones_like(x), epsilon), (1, 1), method="Nelder-Mead", tol=1e-12)
    assert fit.objective == pytest.approx(found.fun, rel=1e-8)
    assert fit.objective <= found.fun * (1 + 1e-10)


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
@example(n=2, seed=1155, outliers=1.0, epsilon=1e-6, weighted=True)  # where the step to a feasible dual lost digits
def test_the_gap_bounds_the_distance_to_every_other_line(n, seed, outliers, epsilon, weighted) -> None:
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
    assert np.mean([fit.scale_error for fit in fits]) == pytest.approx(np.std([fit.scale for fit in fits]), rel=0.15)


CERTIFIED = 1e-9


def leverage() -> tuple[np.ndarray, np.ndarray]:
    x, y = line()
    y[np.argsort(x)[-8000:]] = np.random.default_rng(1).uniform(0.3, 0.6, 8000)
    return x, y


NORMAL, UNIFORM = np.random.default_rng(0).normal(size=500), np.random.default_rng(1).uniform(1, 6, 500)
FROM_1E_3_TO_1E6 = 10 ** np.random.default_rng(0).uniform(-3, 6, 500)


def scaled(x_scale: float, x_shift: float, y_scale: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = line()
    return x * x_scale + x_shift, y * y_scale


OK, BOUNDARY = AlignStatus.OK, AlignStatus.BOUNDARY

CASES = {
    "clean": (line(), OK),
    "60 % outliers": (line(outliers=0.6), OK),
    "40 % leverage outliers": (leverage(), BOUNDARY),
    "anti-correlated": (scaled(-1, 0, 1), AlignStatus.WRONG_KIND),
    "constant map": ((3.3 + 0 * NORMAL, UNIFORM), AlignStatus.FLAT),
    "nearly constant map": ((3.3 + 1e-9 * NORMAL, UNIFORM), AlignStatus.FLAT),
    "all anchors at one depth": ((UNIFORM, 4 + 0 * NORMAL), AlignStatus.ONE_DEPTH),
    "one depth with noise": ((UNIFORM, 4 + 1e-3 * NORMAL), AlignStatus.UNSTABLE),
    "no anchor": (line(0), AlignStatus.EMPTY),
    **{f"{n} anchors": (line(n), AlignStatus.TOO_FEW) for n in (1, 2, 5)},
    "depth in millimetres": (scaled(1, 0, 1e-3), OK),
    "depth in megametres": (scaled(1, 0, 1e6), OK),
    "map with a huge offset": (scaled(1e6, 1e8, 1), OK),
    "depth from 1e-3 to 1e6": (((FROM_1E_3_TO_1E6 - 0.5) / 2 * (1 + 0.01 * NORMAL), FROM_1E_3_TO_1E6), OK),
    "200,000 anchors": (line(200_000), OK),
    "zero residual": (line(noise=0.0), OK),
    "one value of a million": ((np.r_[UNIFORM, 1e6], np.r_[UNIFORM, 3]), OK),
    "unrelated": ((NORMAL, UNIFORM), AlignStatus.UNSTABLE),
    "three leverage points": ((np.r_[np.ones(500), [1.5] * 3], np.r_[4 + 0.01 * NORMAL, [5] * 3]), AlignStatus.FLAT),
}

ALSO_RIGHT = {
    "40 % leverage outliers": {AlignStatus.WRONG_KIND},  # the ranks contradict as well
    "one depth with noise": {BOUNDARY, AlignStatus.ONE_DEPTH},  # the sign of a scale that is noise is a coin toss
    "unrelated": {BOUNDARY},
}


@pytest.mark.parametrize("residual", ["absolute", "relative"])
@pytest.mark.parametrize("name", CASES)
def test_each_case_is_solved_to_its_certificate_and_used_or_refused_for_the_right_reason(name, residual) -> None:
    (x, y), expected = CASES[name]
    absolute = residual == "absolute"
    settings = AlignSettings(residual=residual, epsilon=0.01 if absolute else 0.02)
    assert align(x[None], y[None], kind="metric", settings=settings).status in {expected, *ALSO_RIGHT.get(name, ())}
    if len(x):
        epsilon = settings.epsilon * (float(np.median(y)) if absolute else 1)
        assert fit_affine(x, y, None if absolute else 1 / y, epsilon=epsilon).gap <= CERTIFIED


@pytest.mark.parametrize(("epsilon", "outliers"), [(1e-1, 0.45), (1e-2, 0.6), (1e-5, 0.6), (1e-8, 0.6)])
def test_smoothing_down_to_nearly_absolute_values_is_still_certified(epsilon: float, outliers: float) -> None:
    x, y = line(outliers=outliers)
    fit = fit_affine(x, y, epsilon=epsilon * float(np.median(y)))
    assert fit.gap <= CERTIFIED
    assert fit.scale == pytest.approx(2, rel=0.08)

"""Stiff and extreme alignments: certified, or refused for the right reason (cases 43 and 45 of the inventory)."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.priors.monocular.affine import fit_affine
from d2_plugin.priors.monocular.align import AlignStatus, align
from d2_plugin.priors.settings import AlignSettings

CERTIFIED = 1e-9


def line(n: int = 20_000, noise: float = 0.01, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y = rng.uniform(1, 6, n)
    return (y - 0.5) / 2 + rng.normal(0, noise / 2, n), y


def with_outliers(share: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = line()
    rng = np.random.default_rng(1)
    wrong = rng.choice(len(y), int(share * len(y)), replace=False)
    y[wrong] = rng.uniform(0.5, 12, len(wrong))
    return x, y


def leverage() -> tuple[np.ndarray, np.ndarray]:
    x, y = line()
    y[np.argsort(x)[-8000:]] = np.random.default_rng(1).uniform(0.3, 0.6, 8000)
    return x, y


def logarithmic() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    y = 10 ** rng.uniform(-3, 6, 20_000)
    return (y - 0.5) / 2 * (1 + 0.01 * rng.normal(size=len(y))), y


def few_leverage_points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return np.r_[np.ones(500), 1.5 * np.ones(3)], np.r_[rng.normal(4, 0.01, 500), [5, 5, 5]]


def unrelated() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=20_000), rng.uniform(1, 6, 20_000)


def constant(spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return 3.3 + spread * rng.normal(size=500), rng.uniform(1, 6, 500)


def one_depth(noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(0, 1, 500), 4 + noise * rng.normal(size=500)


def scaled(x_scale: float, x_shift: float, y_scale: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = line()
    return x * x_scale + x_shift, y * y_scale


OK, BOUNDARY = AlignStatus.OK, AlignStatus.BOUNDARY
CASES = {
    "clean": (line(), OK),
    "30 % outliers": (with_outliers(0.3), OK),
    "45 % outliers": (with_outliers(0.45), OK),
    "60 % outliers": (with_outliers(0.6), OK),
    "40 % leverage outliers": (leverage(), BOUNDARY),
    "anti-correlated": ((-line()[0], line()[1]), AlignStatus.WRONG_KIND),
    "constant map": (constant(0), AlignStatus.FLAT),
    "nearly constant map": (constant(1e-9), AlignStatus.FLAT),
    "all anchors at one depth": (one_depth(0), AlignStatus.ONE_DEPTH),
    "one depth with noise": (one_depth(1e-3), AlignStatus.UNSTABLE),
    "no anchor": (line(0), AlignStatus.EMPTY),
    **{f"{n} anchors": (line(n), AlignStatus.TOO_FEW) for n in (1, 2, 3, 5)},
    "depth in millimetres": (scaled(1, 0, 1e-3), OK),
    "depth in megametres": (scaled(1, 0, 1e6), OK),
    "map with a huge offset": (scaled(1e6, 1e8, 1), OK),
    "depth from 1e-3 to 1e6": (logarithmic(), OK),
    "200,000 anchors": (line(200_000), OK),
    "zero residual": (line(noise=0.0), OK),
    "unrelated": (unrelated(), AlignStatus.UNSTABLE),
    "three leverage points": (few_leverage_points(), AlignStatus.FLAT),
}

ALSO_RIGHT = {
    "40 % leverage outliers": {AlignStatus.WRONG_KIND},  # the ranks contradict as well
    "one depth with noise": {BOUNDARY, AlignStatus.ONE_DEPTH},  # the sign of a scale that is noise is a coin toss
    "unrelated": {BOUNDARY},
}


@pytest.mark.parametrize("residual", ["absolute", "relative"])
@pytest.mark.parametrize("name", CASES)
def test_each_case_is_solved_to_its_certificate_and_used_or_refused_for_the_right_reason(
    name: str, residual: str
) -> None:
    (x, y), expected = CASES[name]
    absolute = residual == "absolute"
    settings = AlignSettings(residual=residual, epsilon=0.01 if absolute else 0.02)
    alignment = align(x[None], y[None], kind="metric", settings=settings)
    assert alignment.status in {expected, *ALSO_RIGHT.get(name, ())}
    if len(x):
        epsilon = settings.epsilon * (float(np.median(y)) if absolute else 1)
        assert fit_affine(x, y, None if absolute else 1 / y, epsilon=epsilon).gap <= CERTIFIED


@pytest.mark.parametrize("epsilon", [1e-1, 1e-3, 1e-5, 1e-8])
def test_smoothing_down_to_nearly_absolute_values_is_still_certified(epsilon: float) -> None:
    x, y = with_outliers(0.45)
    fit = fit_affine(x, y, epsilon=epsilon * float(np.median(y)))
    assert fit.gap <= CERTIFIED
    assert fit.scale == pytest.approx(2, rel=0.08)


def test_sixty_per_cent_outliers_move_the_scale_by_a_few_per_cent_only() -> None:
    x, y = with_outliers(0.6)
    alignment = align(x[None], y[None], kind="metric", settings=AlignSettings())
    assert alignment.scale == pytest.approx(2, rel=0.05)
    assert alignment.inliers == pytest.approx(0.45, abs=0.05)

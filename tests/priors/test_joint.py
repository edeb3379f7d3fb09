"""Lines of several frames fitted together: certified, the single fits where nothing ties them, told by others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.monocular.affine import charbonnier, fit_affine
from d2_plugin.priors.monocular.joint import Anchors, JointFit, Tie, fit_joint

EPSILON = 0.02


def recording(
    frames: int, anchors: int, ties: int, noise: float = 0.01, wrong: float = 0.0, seed: int = 0
) -> tuple[list[Anchors], list[Tie], np.ndarray]:
    """Frames of one still image, each with a line of its own; (anchors, ties, true scales).

    Noise is that of the anchors: that of ties would make the lines flatter (`together` averages it out).
    """
    rng = np.random.default_rng(seed)
    scales, shifts = rng.uniform(0.5, 2, frames), rng.uniform(-0.2, 0.2, frames)
    inverse = rng.uniform(0.1, 1, 2000)
    maps = [(inverse - shift) / scale for scale, shift in zip(scales, shifts)]
    known = []
    for map_ in maps:
        rows = rng.permutation(2000)[:anchors]
        y = np.where(rng.random(anchors) < wrong, rng.uniform(0.1, 1, anchors), inverse[rows])
        known.append(Anchors(map_[rows] + rng.normal(0, noise, anchors), y, 1 / y))
    pairs = [Tie(f, f + 1, maps[f][:ties], maps[f + 1][:ties], 2.0) for f in range(frames - 1)] if ties else []
    return known, pairs, scales


def objective(fit: JointFit, frames: list[Anchors], ties: list[Tie], moved: np.ndarray | None = None) -> float:
    """The sum of the module's docstring, written down once more; `moved` [2, F] is added to scales and shifts."""
    a, b = np.array([fit.scales, fit.shifts]) + (0 if moved is None else moved)
    total = sum(charbonnier(f.weights * (a[i] * f.x + b[i] - f.y), EPSILON).sum() for i, f in enumerate(frames))
    for t in ties:
        apart = a[t.first] * t.x_first + b[t.first] - a[t.second] * t.x_second - b[t.second]
        total += charbonnier(t.weight * apart, EPSILON).sum()
    return float(total)


def test_without_ties_it_is_the_fit_of_each_frame() -> None:
    frames, _, _ = recording(5, 400, 0, wrong=0.2)
    joint = fit_joint(frames, [], epsilon=EPSILON)
    alone = [fit_affine(f.x, f.y, f.weights, epsilon=EPSILON) for f in frames]
    np.testing.assert_allclose(joint.scales, [fit.scale for fit in alone], rtol=1e-5)
    np.testing.assert_allclose(joint.shifts, [fit.shift for fit in alone], atol=1e-5)
    np.testing.assert_allclose(joint.scale_errors, [fit.scale_error for fit in alone], rtol=1e-3)
    assert joint.objective == pytest.approx(sum(fit.objective for fit in alone), rel=1e-8)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 6), st.integers(5, 200), st.integers(0, 200), st.floats(0, 0.5), st.integers(0, 10**6))
def test_the_gap_is_certified_and_nothing_is_lower(n: int, anchors: int, ties: int, wrong: float, seed: int) -> None:
    frames, pairs, _ = recording(n, anchors, ties, wrong=wrong, seed=seed)
    fit = fit_joint(frames, pairs, epsilon=EPSILON)
    assert 0 <= fit.gap < 1e-8
    value = objective(fit, frames, pairs)
    assert fit.objective == pytest.approx(value, rel=1e-9)
    rng = np.random.default_rng(seed)
    for size in (1e-1, 1e-3):
        assert objective(fit, frames, pairs, size * rng.standard_normal((2, n))) >= value * (1 - 1e-8)


def test_a_fit_that_is_cut_off_says_so() -> None:
    frames, pairs, _ = recording(4, 200, 200, wrong=0.4)
    assert fit_joint(frames, pairs, epsilon=EPSILON, max_iterations=0).gap > 1e-6


def test_a_frame_without_anchors_is_told_by_its_neighbours() -> None:
    frames, pairs, scales = recording(4, 400, 800, noise=1e-3)
    frames[2] = Anchors(*(np.zeros(0) for _ in range(3)))
    fit = fit_joint(frames, pairs, epsilon=EPSILON)
    np.testing.assert_allclose(fit.scales, scales, rtol=0.01)


def test_neighbours_help_where_anchors_are_few() -> None:
    alone, tied = [], []
    for seed in range(5):
        frames, pairs, scales = recording(8, 30, 500, noise=0.02, wrong=0.2, seed=seed)
        alone.append(np.abs(fit_joint(frames, [], epsilon=EPSILON).scales / scales - 1).mean())
        tied.append(np.abs(fit_joint(frames, pairs, epsilon=EPSILON).scales / scales - 1).mean())
    assert np.mean(tied) < 0.8 * np.mean(alone)


@pytest.mark.parametrize(("factor", "offset"), [(1e6, 0.0), (1e-6, 0.0), (1.0, 1e6)])
def test_units_of_the_map_do_not_matter(factor: float, offset: float) -> None:
    frames, pairs, _ = recording(3, 300, 300, wrong=0.2)
    fit = fit_joint(frames, pairs, epsilon=EPSILON)
    other = fit_joint(
        [f._replace(x=factor * f.x + offset) for f in frames],
        [t._replace(x_first=factor * t.x_first + offset, x_second=factor * t.x_second + offset) for t in pairs],
        epsilon=EPSILON,
    )
    np.testing.assert_allclose(other.scales * factor, fit.scales, rtol=1e-4)

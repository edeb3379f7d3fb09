"""The compiled parts of alignment and correction agree with the NumPy code, which runs where there is no compiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.fuse import fuse
from d2_plugin.priors.monocular.affine import fit_affine
from d2_plugin.priors.monocular.align import (
    Alignment,
    AlignStatus,
    align,
    aligned_depth,
    aligned_inverse,
    inverse_at_least,
    unjudged_line,
)
from d2_plugin.priors.monocular.correct import corrected_without
from d2_plugin.priors.monocular.native import library, points
from d2_plugin.priors.settings import AlignSettings
from d2_plugin.recordings.recording import MonoKind

pytest.importorskip("cv2")
pytestmark = pytest.mark.skipif(library.library() is None, reason="no C++ compiler")

SETTINGS = AlignSettings()


def without_compiler(call: Callable[[], Any]) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "library", lambda: None)
        patch.setattr(points, "library", lambda: None)
        return call()


class Views:
    """A map, anchors with the share `known`, bent by `bend` in log depth, and three choices of left-out anchors."""

    def __init__(self, height: int, width: int, known: float, bend: float, seed: int) -> None:
        random, shape = np.random.default_rng(seed), (height, width)
        self.aligned = random.uniform(0, 4, shape).astype(np.float32) * (random.random(shape) < 0.9)
        geometric = self.aligned * np.exp(random.normal(0, bend, shape))
        self.geometric = np.where(random.random(shape) < known, geometric, 0).astype(np.float32)
        self.left_out = random.random((3, *shape)) < np.array([0, 0.5, 1])[:, None, None]

    def corrected(self, **changes: object) -> np.ndarray:
        return corrected_without(self.aligned, self.geometric, self.left_out, AlignSettings(**changes))


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 60),
    width=st.sampled_from([1, 2, 15, 16, 17, 80, 107, 119, 160, 170, 641, 2100]),
    known=st.sampled_from([0, 1e-3, 0.3, 1]),
    bend=st.sampled_from([0, 1e-6, 0.1, 2, 15]),
    prior=st.sampled_from([1e-30, 0.05, 1e6]),
    scale=st.sampled_from([1e-3, 0.03, 0.25, 30]),
    seed=st.integers(0, 99),
)
def test_corrected_maps_are_those_of_numpy_to_the_last_digits(
    height: int, width: int, known: float, bend: float, prior: float, scale: float, seed: int
) -> None:
    views = Views(height, width, known, bend, seed)
    changes = {"local_scales": (0.12, scale), "local_prior": prior}
    expected = without_compiler(lambda: views.corrected(**changes))
    np.testing.assert_allclose(views.corrected(**changes), expected, rtol=2e-6)


def test_the_field_of_a_image_is_the_bits_of_numpy_where_its_sums_run_along_the_same_way() -> None:
    """So it is on the machines of the project: 80 cells across fill whole vectors of its BLAS."""
    views = Views(90, 160, 0.3, 0.1, seed=1)
    expected = without_compiler(views.corrected)
    assert (views.corrected() == expected).mean() > 0.99


def test_corrections_do_not_depend_on_the_number_of_threads() -> None:
    views, before = Views(97, 161, 0.3, 0.1, seed=2), torch.get_num_threads()
    found = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        found.append(views.corrected())
    torch.set_num_threads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_infinite_and_missing_depths_change_nothing_around_them() -> None:
    views = Views(40, 80, 0.5, 0.1, seed=3)
    plain = views.corrected()
    empty = np.argwhere(views.geometric == 0)
    views.geometric[tuple(empty[0])], views.geometric[tuple(empty[1])] = np.inf, np.nan
    np.testing.assert_array_equal(views.corrected(), plain)
    assert np.isfinite(plain).all()


def test_each_choice_of_anchors_is_corrected_as_if_it_were_alone() -> None:
    views = Views(90, 160, 0.3, 0.1, seed=4)
    together = views.corrected()
    for index, hole in enumerate(views.left_out):
        rest = np.where(hole, 0, views.geometric)
        alone = corrected_without(views.aligned, rest, np.zeros((1, 1, 1), bool), SETTINGS)[0]
        np.testing.assert_array_equal(together[index], alone)
    np.testing.assert_array_equal(together[2], views.aligned, "without anchors there is no correction")
    assert (together[0] != together[1]).any()


def both_ways(call: Callable[[], Any]) -> tuple[Any, Any]:
    """What the compiled code gives, and what NumPy gives."""
    return call(), without_compiler(call)


@settings(max_examples=80, deadline=None)
@given(
    count=st.integers(1, 70),
    spread=st.sampled_from([0, 1e-12, 1, 1e6]),
    epsilon=st.sampled_from([1e-100, 1e-8, 0.02, 1e8]),
    a=st.sampled_from([2.0, 0, -1]),
    seed=st.integers(0, 99),
)
def test_sums_over_points_are_those_of_numpy(count: int, spread: float, epsilon: float, a: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    p, q = spread * random.normal(size=count), random.uniform(0.5, 2, count)
    t = a * p + np.where(random.random(count) < 0.4, 50, 0.01) * random.normal(size=count)
    given = points.Points(p, q, t, epsilon)
    found, expected = both_ways(lambda: given.sums(a, 0.1))
    assert found.value == pytest.approx(expected.value, rel=1e-12)
    np.testing.assert_allclose(found.slope, expected.slope, atol=1e-13 * max(np.abs(p).sum(), q.sum()))
    for name in ("irls", "newton", "room", "spread"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        # Where all u are at 1 there is no room but what rounding leaves.
        of = given.plain if name in ("room", "spread") else theirs
        np.testing.assert_allclose(ours[::2], theirs[::2], rtol=1e-12, atol=1e-13 * max(of) * (of is given.plain))
        assert ours[1] == pytest.approx(theirs[1], abs=1e-12 * np.sqrt(of[0]) * np.sqrt(of[2]))
    asked = (a, 0.1), ((0.1, -0.2), (0.01, 0.02)), (1.0, 1.5)
    found, expected = both_ways(lambda: given.duals(*asked[0], *asked[1:]))
    for ours, theirs in zip(found, expected):
        assert ours.largest == pytest.approx(theirs.largest, rel=1e-12)
        assert ours.product == pytest.approx(theirs.product, abs=1e-11 * (1 + spread) * np.abs(t).sum())
        assert ours.conjugate == pytest.approx(theirs.conjugate, rel=1e-6)


WIDE = np.geomspace(1e-9, 1e9, 40)
CASES = {
    "one point": ([2.0], [3.0]),
    "two points": ([1.0, 2.0], [5.0, 7.0]),
    "constant x": ([4.0] * 9, np.arange(1.0, 10)),
    "constant y": (np.arange(1.0, 10), [4.0] * 9),
    "exact line": (np.arange(1.0, 30), 3 * np.arange(1.0, 30) + 2),
    "falling line": (np.arange(1.0, 30), 40 - np.arange(1.0, 30)),
    "eighteen decades": (WIDE, 2 * WIDE),
    "far from the origin": (1e8 + np.arange(1.0, 30), 1e-3 * np.arange(1.0, 30) + 1e-4),
    "missing and infinite": ([1.0, 2, 3, np.nan, 5, np.inf], [2.0, 4, 6, 8, np.inf, 1]),
}


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_fits_are_those_of_numpy(name: str, relative: bool) -> None:
    x, y = (np.array(values) for values in CASES[name])
    found, expected = both_ways(lambda: fit_affine(x, y, 1 / y if relative else None, epsilon=0.02))
    assert (found.count, found.flat, found.boundary) == (expected.count, expected.flat, expected.boundary)
    assert found.scale == pytest.approx(expected.scale, rel=1e-9, abs=1e-12)
    assert found.objective == pytest.approx(expected.objective, rel=1e-9, abs=1e-12)
    assert found.gap <= 1e-8


def test_without_points_nothing_is_fitted() -> None:
    assert fit_affine(np.array([np.nan]), np.array([1.0]), epsilon=0.02).count == 0


@pytest.mark.parametrize("anchors", [0, 1, 49, 50, 3000])
@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("depths", ["many", "one", "unrelated"])
def test_the_unjudged_line_is_that_of_the_alignment(anchors: int, kind: MonoKind, depths: str) -> None:
    random = np.random.default_rng(anchors)
    geometric = np.zeros(6000)
    geometric[:anchors] = 4 if depths == "one" else random.uniform(1, 9, anchors)
    truth = random.uniform(1, 9, 6000) if depths == "unrelated" else np.where(geometric > 0, geometric, 5)
    mono = (1 / truth if kind == "relative" else truth) * random.uniform(0.9, 1.1, 6000)
    views = mono.reshape(60, 100), geometric.reshape(60, 100)
    found = align(*views, kind=kind, settings=SETTINGS)
    np.testing.assert_equal(unjudged_line(*views, kind=kind, settings=SETTINGS), (found.scale, found.shift))


def odd_maps(seed: int) -> list[np.ndarray]:
    """Four maps float32 [40, 50] with all that may stand in one: 0, tiny, huge, negative, infinite, NaN."""
    random = np.random.default_rng(seed)
    odd = np.array([0, -0.0, 1e-40, 1e-30, 1e30, -1, np.inf, -np.inf, np.nan], np.float32)
    usual = random.uniform(0, 4, (4, 40, 50)).astype(np.float32)
    return list(np.where(random.random(usual.shape) < 0.2, random.choice(odd, usual.shape), usual))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize(("scale", "shift"), [(1, 0), (0.3, -0.5), (1e-30, 1e30), (2, -1e-3), (0, 0.25)])
@pytest.mark.parametrize("z_far", [5.0, 1e-3, np.inf])
def test_aligned_maps_are_the_bits_of_numpy(kind: MonoKind, scale: float, shift: float, z_far: float) -> None:
    mono, alignment = odd_maps(0)[0], Alignment(AlignStatus.OK, kind, scale=scale, shift=shift)
    np.testing.assert_array_equal(*both_ways(lambda: aligned_depth(mono, alignment, z_far)))
    np.testing.assert_array_equal(*both_ways(lambda: aligned_inverse(mono, alignment)))


@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("seed", range(20))
def test_no_aligned_inverse_lies_below_the_bound_that_spares_the_map(kind: MonoKind, seed: int) -> None:
    random = np.random.default_rng(seed)
    mono = random.normal(random.normal(), 1, (9, 9)).astype(np.float32) * (random.random((9, 9)) < random.random() * 2)
    mono[0, :2] = np.nan, np.inf
    alignment = Alignment(AlignStatus.OK, kind, scale=random.uniform(0.1, 2), shift=random.normal())
    bound, inverse = inverse_at_least(mono, alignment), aligned_inverse(mono, alignment)
    assert np.isnan(bound) or not (inverse < bound - 1e-12 * abs(bound)).any()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 99),
    tau=st.sampled_from([0.0, 0.1, 1, np.inf, "map"]),
    most_vetoed=st.sampled_from([0.0, 0.3, 1]),
    hanging=st.booleans(),
    sigma=st.sampled_from([0, 0.1, np.inf]),
)
def test_fusion_is_the_bits_of_numpy(
    seed: int, tau: float | str, most_vetoed: float, hanging: bool, sigma: float
) -> None:
    mono, geometric, tau_map, sigmas = odd_maps(seed)
    asked = {
        "tau_c": tau_map if tau == "map" else tau,
        "most_vetoed": most_vetoed,
        "hanging": sigmas > 2 if hanging else None,
        "sigma_mono": np.full_like(mono, sigma),
        "sigma_geometric": sigmas,
    }
    found, expected = both_ways(lambda: fuse(mono, geometric, **asked))
    for name in ("depth", "labels", "sigma"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        assert getattr(found, name).dtype == getattr(expected, name).dtype

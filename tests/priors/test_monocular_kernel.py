"""The compiled parts of alignment and correction agree with the NumPy code, which runs where there is no compiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.captures.capture import MonoKind
from d2_plugin.priors.monocular.affine import fit_affine
from d2_plugin.priors.monocular.align import align, unjudged_line
from d2_plugin.priors.monocular.correct import corrected_without
from d2_plugin.priors.monocular.native import library, points
from d2_plugin.priors.settings import AlignSettings

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


def test_the_field_of_a_picture_is_the_bits_of_numpy_where_its_sums_run_along_the_same_way() -> None:
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

"""The compiled parts of alignment and correction agree with the NumPy code, which runs where there is no compiler."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.monocular import kernel
from d2_plugin.priors.monocular.correct import corrected_without
from d2_plugin.priors.settings import AlignSettings

pytest.importorskip("cv2")
pytestmark = pytest.mark.skipif(kernel.library() is None, reason="no C++ compiler")

SETTINGS = AlignSettings()


def without_compiler(call: Callable[[], np.ndarray]) -> np.ndarray:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "library", lambda: None)
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

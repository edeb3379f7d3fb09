"""The compiled precision of geometric depth has the bits of the NumPy code; its scatter is that of a fitted plane."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.filtering.precision import SLACK, WINDOW, geometric_sigma, plane_scatter

pytest.importorskip("cv2")
compiled = pytest.mark.skipif(kernel.library() is None, reason="no C++ compiler")

Maps = dict[str, np.ndarray]


def random_maps(width: int, height: int, unit: float, noise: float, known: float, seed: int) -> Maps:
    """A slanted plane, noisy and with holes, and what is known of it, some of it NaN, infinite or out of its range."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth = unit / (0.2 + 0.1 * u / width + 0.05 * v / height) * np.exp(random.normal(0, noise, (height, width)))
    depth = np.where(random.random(depth.shape) < known, depth, 0)
    odd = [0.0, -1.0, np.nan, np.inf, -np.inf, 7.0]
    maps = {"coherence": 1.0, "parallax": 300.0, "spread": 0.02, "gradient": 0.1}
    drawn = {name: high * random.random(depth.shape) for name, high in maps.items()}
    drawn["depth"] = depth
    return {
        name: np.where(random.random(depth.shape) < 0.05, random.choice(odd, depth.shape), map_).astype(
            np.float64 if name in ("parallax", "spread") else np.float32
        )
        for name, map_ in drawn.items()
    }


def judged(maps: Maps, window: int = WINDOW) -> tuple[np.ndarray, np.ndarray]:
    """(sigma, scatter)."""
    with np.errstate(all="ignore"):
        depth = np.where(np.isfinite(maps["depth"]), maps["depth"], 0)
        return geometric_sigma(**maps), plane_scatter(depth, window)


def without_compiler(maps: Maps, window: int = WINDOW) -> tuple[np.ndarray, np.ndarray]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "library", lambda: None)
        return judged(maps, window)


@compiled
@settings(max_examples=40, deadline=None)
@given(
    width=st.integers(1, 70),
    height=st.integers(1, 40),
    exponent=st.integers(-6, 6),
    noise=st.sampled_from([0.0, 1e-3, 0.02, 3.0]),
    known=st.sampled_from([0.1, 0.9, 1.0]),
    window=st.sampled_from([1, 3, 7, 9]),
    seed=st.integers(0, 1000),
)
def test_both_return_the_same_bits(
    width: int, height: int, exponent: int, noise: float, known: float, window: int, seed: int
) -> None:
    maps = random_maps(width, height, 10.0**exponent, noise, known, seed)
    for ours, theirs in zip(judged(maps, window), without_compiler(maps, window)):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


@compiled
@pytest.mark.parametrize("value", [1e-45, 1e-38, 1e-6, 1e6, 3e38, 0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["depth", "coherence", "parallax", "spread", "gradient"])
def test_both_agree_on_extremes(name: str, value: float) -> None:
    maps = random_maps(30, 20, 1.0, 1e-3, 0.9, 0)
    maps[name][::2, ::3] = value
    for ours, theirs in zip(judged(maps), without_compiler(maps)):
        np.testing.assert_array_equal(ours, theirs)
    assert not np.isnan(judged(maps)[0]).any()


@compiled
def test_the_number_of_threads_changes_nothing() -> None:
    maps, before, found = random_maps(61, 43, 1.0, 1e-3, 0.9, 1), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(judged(maps))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for ours, theirs in zip(found[0], other):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 0.3])
def test_the_scatter_is_that_of_the_plane_fitted_by_least_squares(noise: float) -> None:
    """At the rim and beside holes too, where a window holds fewer pixels."""
    maps = random_maps(23, 17, 5.0, noise, 0.8, 3)
    depth = np.where(np.isfinite(maps["depth"]) & (maps["depth"] > 0), maps["depth"], 0).astype(np.float64)
    found, reach = plane_scatter(depth), WINDOW // 2
    for row, column in zip(*np.nonzero(depth)):
        window = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        v, u = np.nonzero(depth[window])
        inverse = 1 / depth[window][v, u]
        design = np.stack([u, v, np.ones(len(u))], -1).astype(np.float64)
        # The slack holds slopes down as if by this much of a further observation of zero.
        held = np.sqrt(len(u) * SLACK) * np.eye(3)[:2]
        centred = design[:, :2] - design[:, :2].mean(0)
        slopes = np.linalg.lstsq(
            np.vstack([centred, held[:, :2]]), np.append(inverse - inverse.mean(), [0, 0]), rcond=None
        )[0]
        left = np.mean((inverse - inverse.mean()) ** 2) - np.mean((inverse - inverse.mean()) * (centred @ slopes))
        expected = np.sqrt(max(left, 0)) * depth[row, column]
        assert found[row, column] == pytest.approx(expected, rel=1e-5, abs=1e-7)

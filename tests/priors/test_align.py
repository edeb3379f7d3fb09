"""Alignment of a monocular map to geometric depth: the right domain, the right line, and reasons for refusing."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.errors import D2Error
from d2_plugin.priors.monocular import align as module
from d2_plugin.priors.monocular.align import (
    Alignment,
    AlignStatus,
    align,
    aligned_depth,
    not_aligned,
    rank_correlation,
    unjudged_line,
)
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


def test_fitting_inverse_depth_as_depth_is_what_the_declared_kind_prevents() -> None:
    depth = depths()
    mono = (1 / depth - 0.05) / 0.3
    alignment = align(mono, anchors(depth), kind="metric", settings=AlignSettings())
    assert alignment.status is AlignStatus.WRONG_KIND
    assert alignment.rank_correlation < -0.9
    assert not aligned_depth(mono, alignment, 100.0).any()


def test_zeros_of_a_saturated_network_are_neither_fitted_nor_given_a_depth() -> None:
    depth = depths()
    mono = np.maximum((1 / depth - 0.2) / 0.3, 0)  # beyond a depth of 5 a ReLU returns zero
    alignment = align(mono, anchors(depth), kind="relative", settings=AlignSettings())
    assert (alignment.scale, alignment.shift) == pytest.approx((0.3, 0.2), rel=5e-3)
    np.testing.assert_array_equal(aligned_depth(mono, alignment, 100.0) > 0, mono > 0)


def test_subsampling_changes_the_aligned_depth_by_less_than_a_thousandth(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.tile(depths(), (4, 4))
    rng = np.random.default_rng(3)
    mono = (1 / depth - 0.05) / 0.3 * (1 + rng.normal(0, 0.02, depth.shape))
    maps = []
    for most in (10**6, 20_000):
        monkeypatch.setattr(module, "MAX_ANCHORS", most)
        maps.append(aligned_depth(mono, align(mono, depth, kind="relative", settings=AlignSettings()), 100.0))
    assert np.abs(maps[1] / maps[0] - 1).max() < 1e-3


def test_depth_that_is_not_positive_is_left_empty_and_never_clamped() -> None:
    alignment = Alignment(AlignStatus.OK, "relative", scale=1.0, shift=-0.5)
    mono = np.array([[0.2, 0.5, 0.501, 0.6, np.nan, np.inf]])
    out = aligned_depth(mono, alignment, z_far=100.0)
    np.testing.assert_allclose(out, [[0, 0, 0, 10, 0, 0]], rtol=1e-6)
    assert out.dtype == np.float32
    metric = Alignment(AlignStatus.OK, "metric", scale=2.0, shift=-1.0)
    np.testing.assert_allclose(aligned_depth(np.array([[0.5, 0.4, 3, 60]]), metric, 100.0), [[0, 0, 5, 0]])


def test_an_unaligned_map_is_used_as_it_is() -> None:
    mono = np.array([[0.5, 0.25]])
    np.testing.assert_allclose(aligned_depth(mono, not_aligned("relative"), 100.0), [[2, 4]])
    np.testing.assert_allclose(aligned_depth(mono, not_aligned("metric"), 100.0), mono)


def test_the_rank_correlation_is_spearmans() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=500), rng.normal(size=500)
    stats = pytest.importorskip("scipy.stats")
    assert rank_correlation(x, y) == pytest.approx(stats.spearmanr(x, y).statistic, abs=1e-12)
    assert rank_correlation(x, np.exp(x)) == pytest.approx(1.0)
    assert rank_correlation(np.round(x), np.round(y)) == pytest.approx(
        stats.spearmanr(np.round(x), np.round(y)).statistic, abs=1e-12
    )
    assert rank_correlation(x, np.ones(500)) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [({"kind": "depth"}, "unknown monocular kind 'depth'"), ({"geometric": np.ones((3, 3))}, "resize the map")],
)
def test_mistakes_are_told_in_one_sentence(change: dict, message: str) -> None:
    arguments = {"mono": np.ones(SHAPE), "geometric": np.ones(SHAPE), "kind": "relative", "settings": AlignSettings()}
    with pytest.raises(D2Error, match=message):
        align(**(arguments | change))
    with pytest.raises(D2Error, match="did you mean 'absolute'"):
        align(np.ones(SHAPE), np.ones(SHAPE), kind="metric", settings=AlignSettings(residual="absolut"))


@pytest.mark.parametrize("anchors", [0, 1, 49, 50, 3000])
@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("depths", ["many", "one", "unrelated"])
def test_the_unjudged_line_is_that_of_the_alignment(anchors: int, kind: str, depths: str) -> None:
    random = np.random.default_rng(anchors)
    geometric = np.zeros(6000)
    geometric[:anchors] = 4 if depths == "one" else random.uniform(1, 9, anchors)
    truth = random.uniform(1, 9, 6000) if depths == "unrelated" else np.where(geometric > 0, geometric, 5)
    mono = (1 / truth if kind == "relative" else truth) * random.uniform(0.9, 1.1, 6000)
    views = mono.reshape(60, 100), geometric.reshape(60, 100)
    alignment = align(*views, kind=kind, settings=AlignSettings())
    line = unjudged_line(*views, kind=kind, settings=AlignSettings())
    np.testing.assert_equal(line, (alignment.scale, alignment.shift))

"""Medians and quantiles are NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from d2_plugin.priors.monocular.order import median, quantile


@given(
    count=st.integers(1, 60),
    dtype=st.sampled_from([np.float32, np.float64]),
    levels=st.sampled_from([1, 3, 10**9]),
    infinite=st.booleans(),
    share=st.sampled_from([0, 0.02, 0.68, 0.995, 1]) | st.floats(0, 1),
    seed=st.integers(0, 99),
)
def test_they_are_those_of_numpy(count: int, dtype: type, levels: int, infinite: bool, share: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    values = (random.integers(-levels, levels, count, endpoint=True) / 7).astype(dtype)
    before = values.copy()
    assert quantile(values, share) == pytest.approx(np.quantile(values.astype(np.float64), share), rel=1e-9, abs=1e-9)
    if infinite:
        values[random.random(count) < 0.3] = np.inf
        before = values.copy()
    assert median(values) == np.median(values)
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("count", [1, 2, 9, 1000])
def test_nan_is_not_passed_over(count: int) -> None:
    values = np.arange(float(count))
    values[count // 3] = np.nan
    assert np.isnan(median(values))
    assert np.isnan(quantile(values, 0.3))

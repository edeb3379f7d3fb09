"""The precision of geometric depth: a plane scatters nowhere, parallax and noise count, nothing unknown is precise."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.priors.stereo.filtering.precision import (
    FLOOR,
    GRAY_NOISE,
    MATCHING,
    WINDOW,
    geometric_sigma,
    grey_gradient,
    plane_scatter,
)

pytest.importorskip("cv2")


def plane(height: int, width: int, unit: float = 1.0) -> np.ndarray:
    """Depth float32 [H, W] of a slanted plane: inverse depth is linear over the image."""
    v, u = np.mgrid[:height, :width]
    return (unit / (0.2 + 0.1 * u / width + 0.05 * v / height)).astype(np.float32)


def sigma_of(depth: np.ndarray, **changes: np.ndarray | float) -> np.ndarray:
    """Sigma with full coherence, no spread, a textured image and a parallax of 100 pixels, but for `changes`."""
    values = {"coherence": 1.0, "parallax": 100.0, "spread": 0.0, "gradient": 0.05} | changes
    return geometric_sigma(depth, **{name: np.broadcast_to(value, depth.shape) for name, value in values.items()})


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize(("height", "width"), [(40, 60), (1014, 1352)])
def test_a_plane_does_not_scatter_whatever_the_unit_and_the_size(unit: float, height: int, width: int) -> None:
    assert plane_scatter(plane(height, width, unit)).max() < 2e-5


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_the_scatter_is_the_noise(noise: float) -> None:
    depth = plane(120, 160)
    noisy = depth * np.exp(noise * np.random.default_rng(0).standard_normal(depth.shape))
    # Of the window's WINDOW^2 values the plane takes three.
    expected = noise * np.sqrt(1 - 3 / WINDOW**2)
    assert np.sqrt(np.mean(plane_scatter(noisy)[4:-4, 4:-4] ** 2)) == pytest.approx(expected, rel=0.03)
    assert np.median(sigma_of(noisy)) > np.median(sigma_of(depth))


def test_sigma_is_the_matching_error_over_the_parallax_and_falls_with_it() -> None:
    depth = plane(40, 60)
    found = [float(np.median(sigma_of(depth, parallax=parallax))) for parallax in (1.0, 10.0, 100.0, 1e4, 1e9)]
    assert found == sorted(found, reverse=True)
    assert found[0] == pytest.approx(np.hypot(MATCHING + GRAY_NOISE / 0.05, FLOOR), rel=1e-3)
    assert found[-1] == pytest.approx(FLOOR, rel=1e-3)


def test_flat_images_incoherence_and_spread_all_make_it_less_sure() -> None:
    depth = plane(40, 60)
    best = np.median(sigma_of(depth, parallax=20.0))
    for worse in ({"gradient": 0.01}, {"coherence": 0.5}, {"spread": 0.05}):
        assert np.median(sigma_of(depth, parallax=20.0, **worse)) > 1.02 * best


def test_where_anything_is_unknown_sigma_is_infinite_and_never_nan() -> None:
    depth = plane(40, 60)
    for row, value in enumerate((0.0, -1.0, np.nan, np.inf)):
        depth[row] = value
    unknown = {"parallax": (4, 0.0), "gradient": (5, np.nan), "coherence": (6, np.nan), "spread": (7, np.nan)}
    defaults = {"parallax": 50.0, "coherence": 1.0, "gradient": 0.05, "spread": 0.0}
    maps = {name: np.full(depth.shape, default) for name, default in defaults.items()}
    for name, (row, value) in unknown.items():
        maps[name][row] = value
    sigma = geometric_sigma(depth, **maps)
    assert np.isinf(sigma[:8]).all()
    assert np.isfinite(sigma[8:]).all()
    assert (sigma > 0).all()
    assert sigma.dtype == np.float32


def test_the_gradient_is_that_of_the_grey_value_whatever_its_direction() -> None:
    rows, columns = np.mgrid[:40, :60]
    ramp = (20 + 2 * columns + rows).astype(np.uint8)
    inside = np.s_[8:-8, 8:-8]
    expected = np.hypot(2, 1) / 255
    np.testing.assert_allclose(grey_gradient(ramp)[inside], expected, rtol=0.02)
    np.testing.assert_allclose(grey_gradient(np.ascontiguousarray(ramp.T)).T[inside], expected, rtol=0.02)
    assert grey_gradient(np.full((9, 9), 7, np.uint8)).max() < 1e-6


def test_a_flat_part_beside_a_textured_one_has_a_gradient() -> None:
    image = np.zeros((180, 320), np.uint8)
    image[:, :107] = np.random.default_rng(2).integers(0, 255, (180, 107))
    gradient = grey_gradient(image)
    assert np.isfinite(gradient).all()
    assert gradient[:, 150:].max() < 1e-6

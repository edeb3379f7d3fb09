"""Surface coherence: depths that share a plane with their neighbours are kept, lonely ones are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.stereo.filtering.coherence import surface_coherence

pytest.importorskip("cv2")

SHAPE = (40, 60)


def plane(slope_x: float, slope_y: float, inverse: float = 0.25) -> np.ndarray:
    """Depth of a plane: inverse depth is linear over the image."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return (1 / (inverse + slope_x * (u - 30) + slope_y * (v - 20))).astype(np.float32)


def coherence(depth: np.ndarray, gray: np.ndarray | None = None) -> np.ndarray:
    flat = np.full(SHAPE, 128, np.uint8)
    return surface_coherence(flat if gray is None else gray, depth, radius=9, relative=0.01, contrast=0.05)


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.003, 0.003), st.floats(-0.003, 0.003), st.floats(1e-3, 1e3))
def test_a_slanted_plane_of_any_scale_is_coherent(slope_x: float, slope_y: float, scale: float) -> None:
    inner = coherence(plane(slope_x, slope_y) * np.float32(scale))[10:-10, 10:-10]
    assert inner.min() > 0.99


def test_random_depths_are_not_coherent() -> None:
    depth = np.random.default_rng(0).uniform(2, 8, SHAPE).astype(np.float32)
    assert coherence(depth).max() < 0.3


def test_a_wrong_piece_of_a_plane_is_not_coherent_and_leaves_its_surroundings_alone() -> None:
    depth = plane(0.001, 0.0)
    depth[18:22, 28:32] *= 1.1
    found = coherence(depth)
    assert found[18:22, 28:32].max() < 0.5
    assert found[18:22, 38:52].min() > 0.9


def test_a_depth_edge_along_an_edge_of_the_image_stays_coherent() -> None:
    depth, gray = plane(0.0, 0.0), np.full(SHAPE, 80, np.uint8)
    depth[:, 30:], gray[:, 30:] = 8.0, 200
    assert coherence(depth, gray)[10:-10, 28].min() > 0.9
    assert coherence(depth)[10:-10, 29].max() < 0.7  # without the image's help the far side counts against it


def test_where_there_is_no_depth_there_is_no_coherence() -> None:
    depth = plane(0.0, 0.0)
    depth[10:30, 20:40] = 0
    found = coherence(depth)
    assert np.isfinite(found).all()
    assert found[10:30, 20:40].max() == 0

"""Confirmation by other views: depth between their pixels on a surface, that of the nearest pixel at an edge."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.priors.geometry import Projection, viewing_rays
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.filtering.confirm import confirm, sample_nearest, sample_surface
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings.recording import Camera

pytest.importorskip("cv2")

WIDTH, HEIGHT, FOCAL, BASELINE = 96, 64, 90.0, 0.5


def camera(name: str, x: float) -> Camera:
    """One of two that look along z from the same height."""
    T = np.eye(4)
    T[0, 3] = -x
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, 8.0], [0, 0, 1]])
    return Camera(name=name, width=WIDTH, height=HEIGHT, K=K, T_camera_world=T)


def ground(view: Camera, slope: float) -> np.ndarray:
    """Planar depth of a ground that rises to the right: y = 1 + slope x in the world; 0 above the horizon."""
    rays = viewing_rays(view, np.float64)
    left = -view.T_camera_world[0, 3]
    falls = rays[..., 1] - slope * rays[..., 0]
    depth = (1 + slope * left) / np.where(falls > 0.02, falls, np.inf)
    return depth.astype(np.float32)


def sources(slope: float, between: bool) -> tuple[np.ndarray, np.ndarray]:
    """(how many sources confirm each exact depth of the left camera, that depth)."""
    cameras = [camera("left", 0.0), camera("right", BASELINE)]
    depths = [ground(view, slope) for view in cameras]
    return confirm(0, cameras, depths, StereoSettings(between_pixels=between, min_angle=0.1)).sources, depths[0]


def test_a_ground_at_a_grazing_angle_is_confirmed_between_pixels_and_not_at_them() -> None:
    found = {}
    for between in (False, True):
        confirmed, depth = sources(1.0, between)
        grazing = (depth > 2) & (depth < 8)
        grazing[:, :30] = False  # leaves the other image
        found[between] = float((confirmed[grazing] > 0).mean())
    assert found[True] > 0.9
    assert found[False] < 0.7


def test_across_an_edge_nothing_is_interpolated() -> None:
    depth = np.full((4, 6), 2.0, np.float32)
    depth[:, 3:] = 4.0
    x, y = np.array([[2.4, 2.6, 1.5, 4.5]]), np.full((1, 4), 1.5)
    at = Projection(x, y, np.ones_like(x))
    np.testing.assert_array_equal(sample_surface(depth, at), [[2.0, 4.0, 2.0, 4.0]])
    np.testing.assert_array_equal(sample_surface(depth, at), sample_nearest(depth, at))


def test_between_four_pixels_of_a_plane_its_inverse_depth_is_exact_and_outside_there_is_none() -> None:
    v, u = np.mgrid[:8, :9]
    depth = (1 / (0.5 + 0.01 * u + 0.02 * v)).astype(np.float32)
    x, y = np.array([[3.3, -0.4, 20.0, 3.0]]), np.array([[2.7, 1.0, 2.0, 2.0]])
    found = sample_surface(depth, Projection(x, y, np.array([[1.0, 1.0, 1.0, -1.0]])))
    assert found[0, 0] == pytest.approx(1 / (0.5 + 0.033 + 0.054), rel=1e-6)
    assert found[0, 1] == depth[1, 0]
    assert found[0, 2] == found[0, 3] == 0


def test_the_paper_reads_depth_at_pixels() -> None:
    assert not PriorSettings.paper().stereo.between_pixels
    kept = PriorSettings.paper(stereo=StereoSettings(cost_max=0.3)).stereo
    assert kept == StereoSettings(cost_max=0.3, between_pixels=False)
    assert StereoSettings().between_pixels

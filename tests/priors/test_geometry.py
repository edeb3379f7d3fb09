"""Two-view geometry in array indices: the half pixel, homography parts, planes, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import (
    check_depth_range,
    check_views,
    pixel_grid,
    scaled_camera,
    triangulation_angle,
    view_pair,
    viewing_rays,
)
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import synthetic_recording


def camera(name: str = "a", x: float = 0.0, turn: float = 0.0, width: int = 64, height: int = 48) -> Camera:
    """A camera at (x, 0, 0), turned about the vertical by `turn` radians."""
    K = np.array([[60.0, 0, 30.5], [0, 58.0, 24.5], [0, 0, 1]])
    cosine, sine = np.cos(turn), np.sin(turn)
    T = np.eye(4)
    T[:3, :3] = [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]
    T[:3, 3] = -T[:3, :3] @ [x, 0, 0]
    return Camera(name, width, height, K, T)


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 63), st.floats(0, 47), st.floats(0.5, 50), st.floats(-1, 1), st.floats(-0.6, 0.6))
def test_a_projection_agrees_with_world_points_and_half_pixel_centres(
    u: float, v: float, depth: float, x: float, turn: float
) -> None:
    reference, source = camera(), camera("b", x, turn)
    at = view_pair(reference, source).project(np.array([u]), np.array([v]), np.array([depth]))
    # Index u has its centre at u + 0.5 in the recording's pixel coordinates.
    local = np.linalg.inv(reference.K) @ [u + 0.5, v + 0.5, 1] * depth
    world = reference.T_camera_world[:3, :3].T @ (local - reference.T_camera_world[:3, 3])
    seen = source.T_camera_world[:3, :3] @ world + source.T_camera_world[:3, 3]
    assert at.z[0] == pytest.approx(seen[2], rel=1e-9, abs=1e-9)
    if seen[2] > 1e-3:
        pixel = source.K @ (seen / seen[2]) - 0.5
        assert (at.x[0], at.y[0]) == pytest.approx((pixel[0], pixel[1]), rel=1e-9, abs=1e-6)


def test_true_depth_of_one_view_lands_on_true_depth_of_the_other() -> None:
    recording = synthetic_recording(cameras=2, frames=1, width=96, height=54)
    first, second = (recording.cameras[name] for name in ("train0", "train1"))
    depth, other = recording.depth("train0", 0), recording.depth("train1", 0)
    at = view_pair(first, second).project(*pixel_grid(first), depth)
    inside = (at.x >= 0) & (at.y >= 0) & (at.x <= 95) & (at.y <= 53) & (at.z > 0)
    there = other[np.rint(at.y[inside]).astype(int), np.rint(at.x[inside]).astype(int)]
    agree = np.abs(there - at.z[inside]) < 0.02 * at.z[inside]
    assert agree.mean() > 0.7  # the rest is hidden from the other view
    assert np.median(np.abs(there - at.z[inside])[agree] / at.z[inside][agree]) < 0.005


def test_a_camera_at_another_size_sees_the_same_rays() -> None:
    view = camera()
    small = scaled_camera(view, 32, 24)
    large_rays, small_rays = viewing_rays(view, np.float64), viewing_rays(small, np.float64)
    averaged = large_rays.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small_rays, averaged, atol=1e-12)


def test_the_angle_is_that_of_the_triangle_and_zero_for_one_centre() -> None:
    reference, source = camera(), camera("b", 0.5)
    depth = np.full((48, 64), 4.0, np.float32)
    angle = triangulation_angle(reference, view_pair(reference, source), depth)
    # At the principal point both rays and the baseline make a right-angled triangle.
    assert angle[24, 30] == pytest.approx(np.arctan2(0.5, 4.0), rel=1e-3)
    same = triangulation_angle(reference, view_pair(reference, camera("c", 0.0, 0.3)), depth)
    assert same.max() < 1e-6


@pytest.mark.parametrize("bounds", [(5.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, np.inf), (np.nan, 2.0)])
def test_an_impossible_depth_range_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(D2Error, match="0 < near < far"):
        check_depth_range(bounds)


def test_images_that_do_not_belong_to_the_cameras_are_refused() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(D2Error, match="one image per camera"):
        check_views([image], [camera(), camera("b", 1)])
    with pytest.raises(D2Error, match="at least 2 cameras"):
        check_views([image], [camera()])
    with pytest.raises(D2Error, match="camera b is 32x24 pixels"):
        check_views([image, image[::2, ::2]], [camera(), camera("b", 1)])


def test_a_pair_that_was_asked_for_before_is_kept_and_a_camera_that_moved_is_another() -> None:
    first, second = camera(), camera("b", 0.5, 0.1)
    pair = view_pair(first, second)
    assert view_pair(camera("of another name"), second) is pair
    with pytest.raises(ValueError, match="read-only"):
        pair.A[0, 0] = 7.0
    second.T_camera_world[0, 3] += 1
    moved = view_pair(first, second)
    np.testing.assert_allclose(moved.k - pair.k, [second.K[0, 0], 0, 0], atol=1e-9)
    np.testing.assert_array_equal(view_pair(first, camera("b", 0.5, 0.1)).k, pair.k)
    first.K[0, 0] *= 2
    assert not np.allclose(view_pair(first, second).A, moved.A)


def test_the_ray_of_a_pixel_projects_back_to_it_even_where_the_axes_are_skewed() -> None:
    view = camera()
    view.K[0, 1] = 3.0
    rays = viewing_rays(view, np.float64)
    u, v = pixel_grid(view, np.float64)
    at = (rays * 1e6) @ view.K.T
    np.testing.assert_allclose(at[..., 0] / at[..., 2] - 0.5, np.broadcast_to(u, rays.shape[:2]), atol=1e-9)
    np.testing.assert_allclose(at[..., 1] / at[..., 2] - 0.5, np.broadcast_to(v, rays.shape[:2]), atol=1e-9)
    assert viewing_rays(view).dtype == np.float32

"""Geometric depth of one instant: cameras and ranges, how good it is, and where it is empty or refused (case 44)."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prior_cases import camera_at
from refusals import refuses

from benchmarks.stereo_rigs import textured_rig
from d2_plugin.priors.geometry import view_pair
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.priors.stereo.depth_range import depth_bounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.geometric_depth import geometric_depth, resampled
from d2_plugin.recordings.cameras.camera import rigid
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")
pytestmark = pytest.mark.usefixtures("compiler")
SETTINGS = StereoSettings(matcher="patchmatch")


@pytest.fixture(scope="module")
def pair() -> Recording:
    """Two views 10 degrees apart."""
    return synthetic_recording(cameras=2, held_out=0, frames=1, width=192, height=108, arc_degrees=10)


@pytest.fixture(scope="module")
def matched(pair: Recording) -> list[GeometricDepth]:
    return run(pair, (2.0, 9.0))


def run(recording: Recording, bounds: tuple[float, float], settings: StereoSettings = SETTINGS) -> list[GeometricDepth]:
    images = [recording.image(name, 0) for name in recording.cameras]
    return geometric_depth(images, list(recording.cameras.values()), bounds, settings)


def test_half_resolution_comes_back_at_full_size() -> None:
    pair = synthetic_recording(cameras=2, held_out=0, frames=1, width=256, height=144, arc_degrees=10)
    found = np.stack([result.depth for result in run(pair, (2.0, 9.0), replace(SETTINGS, max_pixels=128 * 72))])
    truth = np.stack([pair.depth(name, 0) for name in pair.cameras])
    assert found.shape == (2, 144, 256)
    assert (found > 0).mean() > 0.05
    errors = np.abs(found / truth - 1)[found > 0]
    assert np.median(errors) < 0.012
    assert (errors > 0.05).mean() < 0.03


def test_half_the_size_fills_what_the_full_size_leaves_empty(pair, matched, monkeypatch) -> None:
    monkeypatch.setattr("d2_plugin.priors.stereo.geometric_depth.SCALES", (0.5, 1))
    for camera, one, alone in zip(pair.cameras, matched, run(pair, (2.0, 9.0))):
        known = alone.depth > 0
        np.testing.assert_array_equal(one.depth[known], alone.depth[known])
        filled = (one.depth > 0) & ~known
        assert filled.sum() > 0.01 * known.sum()
        assert one.record["survivors"]["filled"] == np.count_nonzero(one.depth)
        errors = np.abs(one.depth[filled] / pair.depth(camera, 0)[filled] - 1)
        assert np.median(errors) < 0.01
        assert (errors < 2 * one.sigma[filled]).mean() > 0.75
        assert np.median(one.sigma[filled]) > np.median(one.sigma[known])


def test_what_is_small_is_found_at_twice_the_size(monkeypatch) -> None:
    """Squares of 14 pixels before a wall, both textured: the window of the filter's coherence, 19 pixels, holds more of
    the wall than of them."""
    rng, squares = np.random.default_rng(0), np.zeros((160, 280), bool)
    for row, column in np.ndindex(4, 6):
        squares[20 + 32 * row :, 40 + 32 * column :][:14, :14] = True
    cv2 = pytest.importorskip("cv2")
    wall, front = (128 + 214 * cv2.GaussianBlur(rng.standard_normal(squares.shape), (0, 0), 1) for _ in range(2))
    views = [
        np.where(squares[:, near : near + 240], front[:, near : near + 240], wall[:, far : far + 240])
        for near, far in ((0, 0), (12, 4))
    ]
    images = [np.repeat(np.rint(view).clip(0, 255).astype(np.uint8)[..., None], 3, -1) for view in views]
    cameras = [camera_at((x, 0, 0), size=(240, 160), focal=200) for x in (0, 1)]
    matching = replace(SETTINGS, min_angle=0.1)
    depth = geometric_depth(images, cameras, (8, 100), matching)[0].depth[squares[:, :240]]
    monkeypatch.setattr("d2_plugin.priors.stereo.geometric_depth.SCALES", (1, 2))
    before = geometric_depth(images, cameras, (8, 100), matching)[0].depth[squares[:, :240]]
    assert np.mean(np.abs(depth / (200 / 12) - 1) < 0.02) > 0.15
    assert np.mean(np.abs(depth[depth > 0] / (200 / 12) - 1) > 0.05) < 0.05
    assert np.mean(before > 0) < 0.02


def geometric(depth: np.ndarray) -> GeometricDepth:
    """One view's depth with a sigma of one per cent."""
    return GeometricDepth(depth, np.where(depth > 0, 0.01, np.inf).astype(np.float32), np.zeros_like(depth), {})


def test_enlarging_a_plane_is_exact_and_an_edge_is_left_out() -> None:
    v, u = np.mgrid[:20, :30]
    inverse = 0.2 + 0.001 * u + 0.002 * v
    large = resampled(geometric((1 / inverse).astype(np.float32)), 60, 40, tolerance=0.05)
    v, u = (np.mgrid[:40, :60] + 0.5) / 2 - 0.5
    inside = np.s_[2:-2, 2:-2]  # the outermost pixels extrapolate, and take the value at the rim
    np.testing.assert_allclose(large.depth[inside], (1 / (0.2 + 0.001 * u + 0.002 * v))[inside], rtol=1e-5)
    step = np.where(np.arange(30) < 15, 2.0, 4.0)[None].repeat(20, 0).astype(np.float32)
    edge = resampled(geometric(step), 60, 40)
    assert set(np.unique(edge.depth)) == {0, 2, 4}
    assert not edge.depth[:, 29:31].any()
    hole = step.copy()
    hole[10, 5] = 0
    assert not resampled(geometric(hole), 60, 40).depth[20:22, 10:12].any()
    np.testing.assert_array_equal(np.isfinite(edge.sigma), edge.depth > 0)
    np.testing.assert_array_equal(edge.sigma[edge.depth > 0], np.float32(0.01))
    back = resampled(large, 30, 20, tolerance=0.05)  # of pixels that were made
    np.testing.assert_allclose(back.sigma[back.depth > 0], 0.02, rtol=1e-6)


def test_the_depth_range_comes_from_points_then_the_data_set_then_the_baselines(pair: Recording) -> None:
    cameras = list(pair.cameras.values())
    rng = np.random.default_rng(0)
    local = np.stack([rng.uniform(-0.3, 0.3, 500), rng.uniform(-0.2, 0.2, 500), np.linspace(3, 5, 500)], axis=1)
    pose = cameras[0].T_camera_world
    points = (local - pose[:3, 3]) @ pose[:3, :3]
    measured = depth_bounds(cameras, points)
    assert 3 * 0.7 < measured.near < 3 * 0.8
    assert 5 * 1.2 < measured.far < 5 * 1.4
    assert "triangulated" in measured.origin
    declared = depth_bounds([replace(camera, near_far=(2.0, 10.0)) for camera in cameras])
    assert declared[:2] == pytest.approx((1.6, 12.0))
    wide = depth_bounds([replace(camera, near_far=None) for camera in cameras], points[:60])  # of one thing, 3 to 3.2
    truth = np.concatenate([pair.depth(name, 0).ravel() for name in pair.cameras])
    assert wide.near < truth.min()
    assert wide.far > truth.max()
    assert "cameras alone" in wide.origin


def test_the_range_from_triangulated_points_holds_what_two_views_see() -> None:
    pytest.importorskip("pycolmap")
    from d2_plugin.priors.colmap.points import triangulate

    rig = textured_rig(2, 240, 135)
    bounds = depth_bounds(rig.cameras, triangulate(rig.images, rig.cameras).positions)
    truth = np.concatenate([depth[seen] for depth, seen in zip(rig.truths, rig.covisible)])
    assert np.mean((truth < bounds.near) | (truth > bounds.far)) < 1e-3
    assert bounds.far / bounds.near < 4 * truth.max() / truth.min()


def test_cameras_that_look_at_each_other_across_a_room_have_a_range_that_holds_it() -> None:
    """At wide angles disparity says nothing about the near end, but the frusta do."""
    room = synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=120)
    bounds = depth_bounds([replace(camera, near_far=None) for camera in room.cameras.values()])
    truth = np.concatenate([room.depth(name, 0).ravel() for name in room.cameras])
    assert 0.05 * truth.min() < bounds.near < truth.min()
    assert bounds.far > truth.max()


def test_points_behind_the_camera_do_not_count_and_cameras_at_one_point_have_no_range(pair: Recording) -> None:
    cameras = list(pair.cameras.values())
    backwards = -5 * cameras[0].T_camera_world[2, :3]
    behind = cameras[0].centre + backwards + np.random.default_rng(0).normal(0, 0.1, (200, 3))
    assert "triangulated" not in depth_bounds(cameras, behind).origin
    refuses("stand at one point", depth_bounds, [replace(cameras[0], near_far=None)] * 2)
    turning = [camera_at((0.3, 0.7, -1.1), turn, size=(64, 48)) for turn in (0, 0.15, -0.2)]  # apart by rounding
    refuses("stand at one point", depth_bounds, turning)
    as_read = [replace(one, T_camera_world=one.T_camera_world.astype(np.float32).astype(float)) for one in turning]
    refuses("stand at one point", depth_bounds, as_read)  # a calibration of seven digits
    step = np.array([1e-5, 0, 0])
    apart = [rigid(one.T_camera_world[:3, :3], one.T_camera_world[:3, 3] - i * step) for i, one in enumerate(turning)]
    assert depth_bounds([replace(one, T_camera_world=pose) for one, pose in zip(turning, apart)]).near > 0


BOUNDS = (2.0, 9.0)


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[Camera]]:
    recording = synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=20)
    return [recording.image(name, 0) for name in recording.cameras], list(recording.cameras.values())


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    return replace(camera, name="turned", T_camera_world=turn @ camera.T_camera_world)


@pytest.mark.parametrize("what", ["no texture", "faint noise", "one camera", "a pure rotation", "no overlap"])
def test_where_nothing_can_be_matched_there_is_next_to_no_depth(views: tuple, what: str) -> None:
    images, cameras = views
    rng = np.random.default_rng(0)
    noise = [np.clip(128 + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in images]
    slightly, away = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    slightly[:2, :2] = [[0.999, -0.0447], [0.0447, 0.999]]
    given = {
        "no texture": ([np.full_like(image, 128) for image in images], cameras),
        "faint noise": (noise, cameras),
        "one camera": ([images[0]] * 3, [cameras[0]] * 3),
        "a pure rotation": ([images[0]] * 2, [cameras[0], turned(cameras[0], slightly)]),
        "no overlap": (images[:2], [cameras[0], turned(cameras[1], away)]),
    }
    for result in geometric_depth(*given[what], BOUNDS, StereoSettings()):
        assert np.isfinite(result.depth).all()
        assert (result.depth > 0).mean() <= (0.01 if what == "faint noise" else 0)


def test_one_black_image_neither_has_depth_nor_takes_it_from_the_others(views: tuple) -> None:
    images, cameras = views
    results = geometric_depth([images[0], np.zeros_like(images[1]), images[2]], cameras, BOUNDS, StereoSettings())
    assert not results[1].depth.any()
    whole = geometric_depth(images[::2], cameras[::2], BOUNDS, StereoSettings())
    assert (results[0].depth > 0).mean() > 0.5 * (whole[0].depth > 0).mean()


def uneven(x: float = 0, turn: float = 0) -> Camera:
    """A camera at (x, 0, 0) whose pixels are no squares."""
    K = np.array([[60.0, 0, 30.5], [0, 58.0, 24.5], [0, 0, 1]])
    return replace(camera_at((x, 0, 0), turn, size=(64, 48)), K=K)


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 63), st.floats(0, 47), st.floats(0.5, 50), st.floats(-1, 1), st.floats(-0.6, 0.6))
def test_a_projection_agrees_with_world_points_and_half_pixel_centres(u, v, depth, x, turn) -> None:
    reference, source = uneven(), uneven(x, turn)
    at = view_pair(reference, source).project(np.array([u]), np.array([v]), np.array([depth]))
    # Index u has its centre at u + 0.5 in the recording's pixel coordinates.
    local = np.linalg.inv(reference.K) @ [u + 0.5, v + 0.5, 1] * depth
    world = reference.T_camera_world[:3, :3].T @ (local - reference.T_camera_world[:3, 3])
    seen = source.T_camera_world[:3, :3] @ world + source.T_camera_world[:3, 3]
    assert at.z[0] == pytest.approx(seen[2], rel=1e-9, abs=1e-9)
    if seen[2] > 1e-3:
        pixel = source.K @ (seen / seen[2]) - 0.5
        assert (at.x[0], at.y[0]) == pytest.approx((pixel[0], pixel[1]), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("bounds", [(5.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, np.inf), (np.nan, 2.0)])
def test_an_impossible_depth_range_is_refused(bounds: tuple[float, float]) -> None:
    refuses("0 < near < far|depth_range", PriorSettings, depth_range=bounds)

"""The synthetic room: exact geometry, real-looking difficulty, the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.synthetic.raycast import render_depth
from d2_plugin.captures.synthetic.room import (
    CACHE_BYTES,
    MonocularEmulation,
    emulated_monocular,
    furnished_room,
    split,
    synthetic_capture,
)
from d2_plugin.errors import D2Error


@pytest.fixture(scope="module")
def capture() -> Capture:
    return synthetic_capture(frames=6, width=120, height=68)


def world_points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World point [H * W, 3] of every pixel centre at its planar depth."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    in_camera = pixels @ np.linalg.inv(camera.K).T * depth.reshape(-1, 1)
    return (in_camera - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]


def test_training_and_held_out_cameras_are_told_by_name(capture: Capture) -> None:
    train, test = split(capture)
    assert train == ["train0", "train1", "train2", "train3"]
    assert test == ["test0", "test1", "test2"]
    centres = {name: camera.centre for name, camera in capture.cameras.items()}
    for i, name in enumerate(test):  # each stands between two neighbours
        assert centres[f"train{i}"][0] < centres[name][0] < centres[f"train{i + 1}"][0]


def test_depth_says_where_another_camera_sees_the_same_surface(capture: Capture) -> None:
    """Points from one camera's depth, seen by another: never in front of the other's depth, mostly on it."""
    first, second = capture.cameras["train1"], capture.cameras["train2"]
    points = world_points(first, capture.depth("train1", 2))
    in_second = points @ second.T_camera_world[:3, :3].T + second.T_camera_world[:3, 3]
    pixels = in_second @ second.K.T
    u, v = (pixels[:, :2] / pixels[:, 2:]).T
    inside = (u >= 1) & (u < second.width - 1) & (v >= 1) & (v < second.height - 1)
    seen = capture.depth("train2", 2)[v[inside].astype(int), u[inside].astype(int)]
    ratio = in_second[inside, 2] / seen
    assert np.mean(np.abs(ratio - 1) < 0.02) > 0.8
    assert np.mean(ratio < 0.97) < 0.03  # only at silhouettes, by up to a pixel


def test_colours_of_one_surface_point_agree_between_cameras(capture: Capture) -> None:
    first, second = capture.cameras["train1"], capture.cameras["train2"]
    points = world_points(first, capture.depth("train1", 2))
    in_second = points @ second.T_camera_world[:3, :3].T + second.T_camera_world[:3, 3]
    pixels = in_second @ second.K.T
    u, v = (pixels[:, :2] / pixels[:, 2:]).T
    inside = (u >= 0) & (u < second.width) & (v >= 0) & (v < second.height)
    rows, columns = v[inside].astype(int), u[inside].astype(int)
    same = np.abs(in_second[inside, 2] / capture.depth("train2", 2)[rows, columns] - 1) < 0.01
    here = capture.image("train1", 2).reshape(-1, 3)[inside][same].astype(float)
    there = capture.image("train2", 2)[rows, columns][same].astype(float)
    matched = np.abs(here - there).mean()
    shuffled = np.abs(here - there[np.random.default_rng(0).permutation(len(there))]).mean()
    assert matched < 0.35 * shuffled


def test_depth_matches_the_sphere_it_is_told_to_be() -> None:
    """The ball's depth against its equation, per pixel of a camera that looks straight at it."""
    scene = furnished_room(seed=0, moving=True)
    ball = next(solid for solid in scene.solids if solid.radius is not None)
    capture = synthetic_capture(cameras=1, held_out=0, frames=1, width=120, height=68)
    camera = capture.cameras["train0"]
    depth = render_depth(scene, camera, 0.5).astype(float)
    distances = np.linalg.norm(world_points(camera, depth) - ball.motion(0.5)[1], axis=1)
    assert distances.min() > ball.radius * (1 - 1e-6)
    on_ball = distances < ball.radius * (1 + 1e-5)
    assert on_ball.sum() > 50


def test_every_pixel_has_a_depth_inside_the_declared_bounds(capture: Capture) -> None:
    for name, camera in capture.cameras.items():
        depth = capture.depth(name, 0)
        assert camera.near_far[0] < depth.min()
        assert depth.max() < camera.near_far[1]


def test_things_move_unless_they_are_told_to_stand_still(capture: Capture) -> None:
    moved = (np.abs(capture.image("train0", 0).astype(int) - capture.image("train0", 5)).max(-1) > 20).mean()
    assert 0.01 < moved < 0.3
    still = synthetic_capture(frames=3, width=64, height=36, moving=False)
    np.testing.assert_array_equal(still.image("train0", 0), still.image("train0", 2))


def test_pictures_are_textured_but_for_the_plaster(capture: Capture) -> None:
    image, camera = capture.image("train1", 0).astype(float), capture.cameras["train1"]
    gradient = np.abs(np.diff(image, axis=1)).mean(-1)
    points = world_points(camera, capture.depth("train1", 0)).reshape(camera.height, camera.width, 3)
    left_wall, bricks = points[:, :-1, 0] < -2.59, points[:, :-1, 1] > 1.99
    assert left_wall.sum() > 100
    assert np.median(gradient[left_wall]) < 0.3 * np.median(gradient[bricks])


def test_the_same_arguments_give_the_same_capture(capture: Capture) -> None:
    again = synthetic_capture(frames=6, width=120, height=68)
    np.testing.assert_array_equal(again.image("test1", 3), capture.image("test1", 3))
    np.testing.assert_array_equal(again.mono("test1", 3), capture.mono("test1", 3))
    other = synthetic_capture(frames=6, width=120, height=68, seed=1)
    assert (other.image("test1", 3) != capture.image("test1", 3)).mean() > 0.2


def test_the_global_random_state_is_left_alone() -> None:
    before = np.random.get_state()[1].copy()
    synthetic_capture(frames=1, width=16, height=16).mono("train0", 0)
    np.testing.assert_array_equal(np.random.get_state()[1], before)


def test_monocular_maps_are_emulated_and_say_so(capture: Capture) -> None:
    assert capture.mono_emulated
    assert capture.mono_kind == "relative"
    assert any("emulated" in note for note in capture.notes)


def test_emulated_maps_are_affine_in_inverse_depth_up_to_a_local_bias(capture: Capture) -> None:
    for frame in range(3):
        inverse, mono = 1 / capture.depth("train2", frame).ravel(), capture.mono("train2", frame).ravel()
        slope, offset = np.polyfit(mono, inverse, 1)
        assert slope > 0
        error = np.abs(slope * mono + offset - inverse) / inverse
        assert 0.01 < np.median(error) < 0.15
    scales = [np.ptp(capture.mono("train2", frame)) / np.ptp(1 / capture.depth("train2", frame)) for frame in range(6)]
    assert max(scales) > 1.3 * min(scales)  # every frame has its own scale


def test_an_emulation_without_errors_is_exact_inverse_depth() -> None:
    exact = MonocularEmulation(edge_blur=0, fixed_bias=0, frame_bias=0, scale=(3, 3), shift=(0.5, 0.5))
    capture = synthetic_capture(cameras=1, held_out=0, frames=1, width=32, height=24, emulation=exact)
    np.testing.assert_allclose(capture.mono("train0", 0), 3 / capture.depth("train0", 0) + 0.5, rtol=1e-5)


def test_the_emulation_blurs_depth_edges() -> None:
    depth = np.full((9, 30), 1.0, np.float32)
    depth[:, 15:] = 4.0
    mono = emulated_monocular(depth, np.zeros((9, 30)), 1.0, 0.0, 2.0)
    assert 0.3 < mono[4, 14] < 0.95
    assert mono[4, 0] == pytest.approx(1)
    assert mono[4, -1] == pytest.approx(0.25)


def test_a_returned_picture_is_the_callers_own(capture: Capture) -> None:
    before = capture.image("train0", 0).copy()
    capture.image("train0", 0)[:] = 0
    np.testing.assert_array_equal(capture.image("train0", 0), before)


def test_the_cache_stays_small() -> None:
    capture = synthetic_capture(cameras=1, held_out=0, frames=3, width=32, height=24)
    source = capture.source
    source._cache["image", "big", 0] = np.zeros(CACHE_BYTES, np.uint8)
    for frame in capture.frames:
        capture.image("train0", frame)
    assert ("image", "big", 0) not in source._cache
    assert sum(array.nbytes for array in source._cache.values()) <= CACHE_BYTES


@pytest.mark.parametrize("wrong", [{"cameras": 0}, {"frames": 0}, {"width": 4}, {"fps": 0.0}, {"held_out": -1}])
def test_impossible_captures_are_refused(wrong: dict) -> None:
    with pytest.raises(D2Error, match="is not possible"):
        synthetic_capture(**wrong)


def test_one_camera_and_one_frame_are_a_capture() -> None:
    capture = synthetic_capture(cameras=1, frames=1, width=16, height=16)
    assert list(capture.cameras) == ["train0"]
    assert capture.image("train0", 0).shape == (16, 16, 3)

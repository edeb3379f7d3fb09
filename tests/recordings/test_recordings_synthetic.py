"""The synthetic room: exact geometry, real-looking difficulty, the same every time."""

import numpy as np
import pytest
from prior_cases import world_points
from refusals import refuses

from benchmarks.priors_motion import scene_flow
from d2_plugin.priors.geometry import projected
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.raycast import render_depth
from d2_plugin.recordings.synthetic.room import furnished_room, synthetic_recording


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(frames=6, width=120, height=68)


def test_what_moves_is_seen_later_where_its_scene_flow_says(recording: Recording) -> None:
    """Points of a frame and their flow: never in front of the depth of a later frame, mostly on it; walls stand."""
    camera, flow = recording.cameras["train1"], scene_flow(recording.source, "train1", 0, 3).reshape(-1, 3)
    moves = np.linalg.norm(flow, axis=1) > 1e-6
    assert 0.01 < moves.mean() < 0.3
    moved = (world_points(camera, recording.depth("train1", 0)) + flow)[moves]
    pixels, depth, _ = projected(camera, moved)
    ratio = depth / recording.depth("train1", 3)[tuple(pixels.astype(int).T[::-1])]
    assert np.mean(np.abs(ratio - 1) < 0.02) > 0.7, "what turns away is not seen any more"
    assert np.mean(ratio < 0.97) < 0.1  # only at silhouettes, by up to a pixel
    np.testing.assert_allclose(scene_flow(recording.source, "train1", 2, 2), 0, atol=1e-6)


def test_depth_matches_the_sphere_it_is_told_to_be() -> None:
    """The ball's depth against its equation, per pixel of a camera that looks straight at it."""
    scene = furnished_room(seed=0, moving=True)
    ball = next(solid for solid in scene.solids if solid.radius is not None)
    recording = synthetic_recording(cameras=1, held_out=0, frames=1, width=120, height=68)
    camera = recording.cameras["train0"]
    depth = render_depth(scene, camera, 0.5).astype(float)
    distances = np.linalg.norm(world_points(camera, depth) - ball.motion(0.5)[1], axis=1)
    assert distances.min() > ball.radius * (1 - 1e-6)
    on_ball = distances < ball.radius * (1 + 1e-5)
    assert on_ball.sum() > 50


def test_the_same_arguments_give_the_same_recording(recording: Recording) -> None:
    again = synthetic_recording(frames=6, width=120, height=68)
    np.testing.assert_array_equal(again.image("test1", 3), recording.image("test1", 3))
    np.testing.assert_array_equal(again.mono("test1", 3), recording.mono("test1", 3))
    other = synthetic_recording(frames=6, width=120, height=68, seed=1)
    assert (other.image("test1", 3) != recording.image("test1", 3)).mean() > 0.2


def test_a_returned_image_is_the_callers_own(recording: Recording) -> None:
    before = recording.image("train0", 0).copy()
    recording.image("train0", 0)[:] = 0
    np.testing.assert_array_equal(recording.image("train0", 0), before)


@pytest.mark.parametrize("wrong", [{"cameras": 0}, {"frames": 0}, {"width": 4}, {"fps": 0.0}, {"held_out": -1}])
def test_impossible_recordings_are_refused(wrong: dict) -> None:
    refuses("is not possible", synthetic_recording, **wrong)

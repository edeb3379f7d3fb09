"""Gains between cameras are measured at surface points, whatever hides some of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from d2_plugin.recordings.checks.exposure import relative_exposures
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.plan import appearance_decision, plan_scene

CAMERAS = ("train0", "train1", "train2")


@pytest.fixture(scope="module")
def room() -> tuple[Recording, np.ndarray, np.ndarray]:
    """A recording and surface points seen in its first image, some of them hidden from the others."""
    recording = synthetic_recording(cameras=4, frames=2, width=160, height=90)
    camera, depth = recording.cameras["train1"], recording.depth("train1", 0)
    rows, columns = np.mgrid[3:87:4, 3:157:4].reshape(2, -1)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1) @ np.linalg.inv(camera.K).T
    points = rays * depth[rows, columns, None]
    world = (points - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
    return recording, world, np.zeros(len(world))


def exposed(recording: Recording, gains: dict[str, tuple[float, float, float]]) -> SimpleNamespace:
    """The recording with a gain per camera and channel."""

    def image(camera: str, frame: int) -> np.ndarray:
        bright = recording.image(camera, frame) * np.array(gains.get(camera, (1, 1, 1)))
        return np.clip(np.rint(bright), 0, 255).astype(np.uint8)

    return SimpleNamespace(
        **{name: getattr(recording, name) for name in ("cameras", "frames", "seconds", "exposures")}, image=image
    )


def test_cameras_of_equal_exposure_agree(room: tuple) -> None:
    recording, points, times = room
    found = relative_exposures(recording, CAMERAS, points, times)
    assert np.abs(found.gains).max() < 0.02
    decision = appearance_decision(recording, CAMERAS, points, times)
    assert not decision.use
    assert "exposures agree" in decision.reason


def test_gains_and_white_balance_are_found(room: tuple) -> None:
    recording, points, times = room
    gains = {"train0": (0.8, 0.8, 0.9), "train2": (1.1, 1.0, 1.0)}
    found = relative_exposures(exposed(recording, gains), CAMERAS, points, times)
    expected = np.log([gains.get(camera, (1, 1, 1)) for camera in CAMERAS])
    plain = relative_exposures(recording, CAMERAS, points, times).gains
    assert np.abs(found.gains - plain - (expected - expected.mean(0))).max() < 0.02
    decision = appearance_decision(exposed(recording, gains), CAMERAS, points, times)
    assert decision.use
    assert "exposures differ" in decision.reason


def test_too_few_points_or_one_camera_decide_nothing(room: tuple) -> None:
    recording, points, times = room
    assert relative_exposures(recording, CAMERAS, points[:5], times[:5]) is None
    assert relative_exposures(recording, CAMERAS, points[:0], times[:0]) is None
    assert not appearance_decision(recording, CAMERAS, points[:5], times[:5]).use
    assert appearance_decision(recording, CAMERAS[:1], points, times).impossible


def test_the_user_has_the_last_word(room: tuple) -> None:
    recording, points, times = room
    plan = plan_scene(recording, list(CAMERAS), None).with_decision(
        appearance_decision(recording, CAMERAS, points, times)
    )
    assert not plan.uses("appearance")
    assert plan.override(appearance=True).uses("appearance")
    assert len(plan.with_decision(plan.measured[-1]).measured) == len(plan.measured)

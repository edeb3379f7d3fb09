"""Gains between cameras are measured at surface points, whatever hides some of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from d2_plugin.captures.capture import Capture
from d2_plugin.captures.checks.exposure import relative_exposures
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.runs.plan import appearance_decision, plan_scene

CAMERAS = ("train0", "train1", "train2")


@pytest.fixture(scope="module")
def room() -> tuple[Capture, np.ndarray, np.ndarray]:
    """A recording and surface points seen in its first picture, some of them hidden from the others."""
    capture = synthetic_capture(cameras=4, frames=2, width=160, height=90)
    camera, depth = capture.cameras["train1"], capture.depth("train1", 0)
    rows, columns = np.mgrid[3:87:4, 3:157:4].reshape(2, -1)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1) @ np.linalg.inv(camera.K).T
    points = rays * depth[rows, columns, None]
    world = (points - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
    return capture, world, np.zeros(len(world))


def exposed(capture: Capture, gains: dict[str, tuple[float, float, float]]) -> SimpleNamespace:
    """The capture with a gain per camera and channel."""

    def image(camera: str, frame: int) -> np.ndarray:
        bright = capture.image(camera, frame) * np.array(gains.get(camera, (1, 1, 1)))
        return np.clip(np.rint(bright), 0, 255).astype(np.uint8)

    return SimpleNamespace(
        **{name: getattr(capture, name) for name in ("cameras", "frames", "seconds", "exposures")}, image=image
    )


def test_cameras_of_equal_exposure_agree(room: tuple) -> None:
    capture, points, times = room
    found = relative_exposures(capture, CAMERAS, points, times)
    assert np.abs(found.gains).max() < 0.02
    decision = appearance_decision(capture, CAMERAS, points, times)
    assert not decision.use
    assert "exposures agree" in decision.reason


def test_gains_and_white_balance_are_found(room: tuple) -> None:
    capture, points, times = room
    gains = {"train0": (0.8, 0.8, 0.9), "train2": (1.1, 1.0, 1.0)}
    found = relative_exposures(exposed(capture, gains), CAMERAS, points, times)
    expected = np.log([gains.get(camera, (1, 1, 1)) for camera in CAMERAS])
    plain = relative_exposures(capture, CAMERAS, points, times).gains
    assert np.abs(found.gains - plain - (expected - expected.mean(0))).max() < 0.02
    decision = appearance_decision(exposed(capture, gains), CAMERAS, points, times)
    assert decision.use
    assert "exposures differ" in decision.reason


def test_too_few_points_or_one_camera_decide_nothing(room: tuple) -> None:
    capture, points, times = room
    assert relative_exposures(capture, CAMERAS, points[:5], times[:5]) is None
    assert relative_exposures(capture, CAMERAS, points[:0], times[:0]) is None
    assert not appearance_decision(capture, CAMERAS, points[:5], times[:5]).use
    assert appearance_decision(capture, CAMERAS[:1], points, times).impossible


def test_the_user_has_the_last_word(room: tuple) -> None:
    capture, points, times = room
    plan = plan_scene(capture, list(CAMERAS), None).with_decision(appearance_decision(capture, CAMERAS, points, times))
    assert not plan.uses("appearance")
    assert plan.override(appearance=True).uses("appearance")
    assert len(plan.with_decision(plan.measured[-1]).measured) == len(plan.measured)

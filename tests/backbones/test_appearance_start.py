"""Exposures that were measured beforehand: where changes of colour begin, and how a held-out camera is shown."""

from __future__ import annotations

import pytest
import torch

from d2_plugin.backbones.appearance import Appearance
from d2_plugin.rasterizer import Render

GAINS = {"a": (1.2, 1.1, 1.0), "b": (0.8, 0.9, 1.0), "held": (1.4, 1.0, 0.7)}


def grey() -> Render:
    return Render(torch.full((2, 2, 3), 0.5), torch.ones(2, 2), torch.ones(2, 2))


def started() -> Appearance:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from(GAINS, ("a", "b"))
    return appearance


@pytest.mark.parametrize("camera", GAINS)
def test_each_camera_sees_its_gain_before_the_first_step(camera: str) -> None:
    with torch.no_grad():
        seen = started().seen_by(camera, grey()).color
    torch.testing.assert_close(seen[0, 0], 0.5 * torch.tensor(GAINS[camera]))


def test_only_training_cameras_learn() -> None:
    appearance = started()
    for camera in GAINS:
        appearance.seen_by(camera, grey()).color.sum().backward() if camera != "held" else None
    assert set(appearance.changes) == {"a", "b"}
    appearance.seen_by("held", grey())
    assert set(appearance.changes) == {"a", "b"}


def test_nothing_begins_where_a_training_camera_has_no_gain() -> None:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from({"a": (1.2, 1.0, 1.0)}, ("a", "b"))
    assert not appearance.changes
    assert not appearance.measured


def test_a_resumed_run_has_the_same_changes() -> None:
    appearance, again = started(), Appearance(torch.device("cpu"))
    appearance.seen_by("a", grey()).color.sum().backward()
    appearance.optimize()
    again.load_state_dict(appearance.state_dict())
    for camera in GAINS:
        with torch.no_grad():
            assert torch.equal(again.seen_by(camera, grey()).color, appearance.seen_by(camera, grey()).color)

"""Cameras of different exposure: gains are learnt or begin as measured, the Gaussians keep the mean colours."""

from __future__ import annotations

import io

import pytest
import torch
from tiny import ALL_HOOKS, BACKBONES, TinyFrames, make_trainer, make_views, parameters, same

from d2_plugin.backbones.appearance import Appearance
from d2_plugin.backbones.trainer import Trainer
from d2_plugin.rasterizer import Render

GAINS = {"cam0": 0.8, "cam1": 1.0, "cam2": 1.2}


class Exposed(TinyFrames):
    """The tiny scene with a gain for each camera."""

    def image(self, index: int) -> torch.Tensor:
        return super().image(index) * GAINS[self.views[index].camera]


def make_exposed(backbone: str = "yang4d", **settings: object) -> Trainer:
    trainer = make_trainer(iterations=400, backbone=backbone, **settings)
    trainer.frames = Exposed()
    return trainer


def test_gains_are_learnt_and_a_camera_that_did_not_train_sees_the_mean() -> None:
    found = {}
    for appearance in (False, True):
        trainer = make_exposed(appearance=appearance, temporal=False)
        trainer.run()
        found[appearance] = trainer.model
    changes = torch.stack([found[True].appearance.change(camera).detach() for camera in GAINS])
    assert changes.mean(0).abs().max() < 1e-6
    gray = (0.5 + changes[:, :, :3].sum(-1) * 0.5 + changes[:, :, 3]).mean(-1)  # what a gray of .5 looks like
    assert (gray[2] - gray[0]).item() == pytest.approx(0.2, abs=0.07)
    truth = TinyFrames().image(0)
    errors = {}
    for appearance, model in found.items():
        with torch.no_grad():
            view = make_views()[0]
            view = view.__class__(**(vars(view) | {"camera": "held out"}))
            errors[appearance] = (model.render(view).color - truth).abs().mean().item()
    assert errors[True] < 0.7 * errors[False], "the colours of its neighbours' exposures"


def test_a_camera_that_never_trained_changes_nothing() -> None:
    appearance, render = Appearance(torch.device("cpu")), Render(*torch.rand(3, 4, 5, 3))
    with torch.no_grad():
        assert appearance.seen_by("held out", render) is render
    assert not appearance.changes


@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(backbone: str) -> None:
    whole, first = (make_trainer(ALL_HOOKS, backbone=backbone, appearance=True) for _ in range(2))
    whole.run()
    first.run(until=17)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = make_trainer(ALL_HOOKS, backbone=backbone, seed=99)  # the checkpoint says that there is an appearance
    second.load_state_dict(torch.load(buffer, weights_only=True))
    second.run()
    assert same(parameters(whole), parameters(second))
    for camera in ("cam0", "cam1", "cam2"):
        assert torch.equal(whole.model.appearance.change(camera), second.model.appearance.change(camera))
    assert whole.model.appearance.change("cam0").abs().max() > 0


MEASURED = {"a": (1.2, 1.1, 1.0), "b": (0.8, 0.9, 1.0), "held": (1.4, 1.0, 0.7)}


def grey() -> Render:
    return Render(torch.full((2, 2, 3), 0.5), torch.ones(2, 2), torch.ones(2, 2))


def started() -> Appearance:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from(MEASURED, ("a", "b"))
    return appearance


@pytest.mark.parametrize("camera", MEASURED)
def test_each_camera_sees_its_gain_before_the_first_step(camera: str) -> None:
    with torch.no_grad():
        seen = started().seen_by(camera, grey()).color
    torch.testing.assert_close(seen[0, 0], 0.5 * torch.tensor(MEASURED[camera]))


def test_only_training_cameras_learn() -> None:
    appearance = started()
    for camera in MEASURED:
        appearance.seen_by(camera, grey()).color.sum().backward() if camera != "held" else None
    assert set(appearance.changes) == {"a", "b"}
    appearance.seen_by("held", grey())
    assert set(appearance.changes) == {"a", "b"}


def test_nothing_begins_where_a_training_camera_has_no_gain() -> None:
    appearance = Appearance(torch.device("cpu"))
    appearance.start_from({"a": (1.2, 1.0, 1.0)}, ("a", "b"))
    assert not appearance.changes
    assert not appearance.measured


def test_measured_changes_are_saved_with_those_that_learn() -> None:
    appearance, again = started(), Appearance(torch.device("cpu"))
    appearance.seen_by("a", grey()).color.sum().backward()
    appearance.optimize()
    again.load_state_dict(appearance.state_dict())
    for camera in MEASURED:
        with torch.no_grad():
            assert torch.equal(again.seen_by(camera, grey()).color, appearance.seen_by(camera, grey()).color)

"""The bundled deformation backbone: its two kinds of field, what they add, what is left out without time."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny import make_model, make_trainer, make_views, parameters

from d2_plugin.backbones.deform import Deform, create
from d2_plugin.backbones.deform_fields import (
    Box,
)
from d2_plugin.backbones.model import decayed_rate
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings

FIELDS = ("mlp", "hexplane")


@pytest.fixture(params=FIELDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def deforming(kind: str) -> Deform:
    """A model past its warm-up whose field moves things."""
    model, generator = make_model(backbone=kind), torch.Generator().manual_seed(1)
    model.deforms = True
    with torch.no_grad():
        for parameter in model.field.heads.parameters():
            parameter.uniform_(-0.1, 0.1, generator=generator)
        for plane in getattr(model.field, "time", ()):
            plane.uniform_(0.5, 1.5, generator=generator)
    return model


class TestModel:
    def test_warm_up_leaves_the_field_out(self, kind: str) -> None:
        model = deforming(kind)
        moved = model.slice_at(make_views()[0]).means
        model.deforms = False
        assert model.offsets(model.gaussians["positions"], 0.0) is None
        assert torch.equal(model.slice_at(make_views()[0]).means, model.gaussians["positions"])
        assert not torch.equal(moved, model.gaussians["positions"])

    def test_warm_up_ends_at_its_fraction_of_the_run(self, kind: str) -> None:
        trainer = make_trainer(iterations=40, backbone=kind)
        trainer.run(until=2)
        assert not trainer.model.deforms
        trainer.run(until=3)
        assert trainer.model.deforms, "0.075 of 40 steps"

    def test_noise_on_time_is_for_training_alone(self, kind: str) -> None:
        model, view = deforming(kind), make_views()[0]
        quiet = model.slice_at(view).means
        model._noise = 0.1
        assert not torch.equal(model.slice_at(view).means, quiet)
        with torch.no_grad():
            assert torch.equal(model.slice_at(view).means, quiet)

    def test_noise_falls_to_zero_at_half_of_the_run(self, kind: str) -> None:
        trainer = make_trainer(iterations=20, backbone=kind)
        trainer.run(until=9)
        assert trainer.model._noise != 0
        trainer.run(until=10)
        assert trainer.model._noise == 0

    def test_all_parameters_learn_after_the_warm_up(self, kind: str) -> None:
        trainer = make_trainer(iterations=30, backbone=kind)
        trainer.run(until=2)
        before = parameters(trainer)
        trainer.run(until=6)
        after = parameters(trainer)
        assert not any(torch.equal(before[name], after[name]) for name in before)

    def test_the_box_holds_the_points_and_not_their_outliers(self) -> None:
        positions = torch.rand(1000, 3) * 2 - 1
        positions[0] = 1e6
        box = Box.around(positions, 1.0)
        assert (box.reach < 1.2).all()
        assert (((positions[1:] - box.centre) / box.reach).abs() <= 1.05).all()
        assert torch.isfinite(Box.around(torch.zeros(0, 3), 2.0).reach).all()
        assert (Box.around(torch.ones(1, 3), 2.0).reach > 0).all()


def test_settings_arrive_through_the_entry_point() -> None:
    model = create(
        torch.rand(4, 3), torch.rand(4, 3), torch.zeros(4), extent=1.0, duration=1.0, temporal=True,
        settings={"field": "hexplane", "sh_degree": 1, "hexplane": {"features": 5}, "densify": {"every": 9}},
    )  # fmt: skip
    assert model.gaussians["harmonics"].shape == (4, 3, 3)
    assert model.field.space[0].shape[1] == 5
    assert model.settings.densify.every == 9


def test_d2_train_runs_and_scores_it(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    recording = save_recording(
        synthetic_recording(cameras=2, held_out=1, frames=2, width=64, height=36), tmp_path / "room"
    )
    settings = RunSettings(
        *(str(recording), ("train0", "train1")),
        backbone="deform",
        iterations=24,
        overrides={"backbone": {"field": "hexplane"}},
        accept_empty_prior=True,  # images this small have no stereo
    )
    run = Run(settings, tmp_path / "run")
    run.train()
    again = Run.load(tmp_path / "run")
    metrics = again.evaluate(images=False)
    assert metrics["backbone"] == "deform"
    assert metrics["iterations"] == 24
    assert metrics["test"]["psnr"] > 8


def test_a_field_that_does_not_learn_has_the_rate_nothing() -> None:
    assert decayed_rate(0.0, 0.0, 5, 10) == 0.0

"""The bundled deformation backbone: its two kinds of field, what they add, what is left out without time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import make_adapter, make_model, make_trainer, make_views, parameters

from d2_plugin.backbones.deform import Deform
from d2_plugin.backbones.deform_fields import (
    Box,
)
from d2_plugin.backbones.densify import grow
from d2_plugin.backbones.model import decayed_rate
from d2_plugin.gaussians.slicing import MARGINAL_CUT, slice_gaussians
from d2_plugin.protocol import Points
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

    def test_a_gaussian_fades_away_from_its_instant_and_goes_where_the_field_says(self, kind: str) -> None:
        model, view, time = deforming(kind), make_views()[0], 0.2
        with torch.no_grad():
            model.gaussians["log_time_scales"].copy_(torch.linspace(-3, 3, len(model)))
        rows = model.gaussians.parameters
        offsets = model.offsets(rows["positions"], time)
        factor = torch.exp(-0.5 * ((time - rows["times"]) / rows["log_time_scales"].exp()) ** 2)
        kept = torch.nonzero(factor > MARGINAL_CUT).squeeze(-1)
        assert 0 < len(kept) < len(model)
        still = {
            "positions": rows["positions"] + offsets.positions,
            "log_scales": rows["log_scales"] + offsets.log_scales,
            "left": rows["rotations"] + offsets.rotations,
            "opacity_logits": rows["opacity_logits"],
        }
        expected, splats = slice_gaussians(still), model.slice_at(replace(view, time=time))
        assert torch.equal(splats.rows, kept)
        torch.testing.assert_close(splats.means, expected.means[kept])
        torch.testing.assert_close(splats.covariances, expected.covariances[kept], rtol=1e-4, atol=1e-7)
        torch.testing.assert_close(splats.opacities, (expected.opacities * factor)[kept])

    def test_gaussians_exist_at_all_instants_at_the_start(self, kind: str) -> None:
        model = make_model(backbone=kind)
        for time in (0.0, model.duration):
            opacities = model.slice_at(replace(make_views()[0], time=time)).opacities
            torch.testing.assert_close(opacities, torch.full((len(model),), 0.5), rtol=0.006, atol=0)

    def test_what_is_inserted_where_things_move_is_gone_at_other_instants(self, kind: str) -> None:
        model, count = deforming(kind), 2
        before = len(model)
        one = torch.full((count,), 0.1)
        lifetimes = torch.tensor([0.02, torch.inf])
        make_adapter(model).insert(Points(torch.rand(count, 3), torch.rand(count, 3), one, one, one, lifetimes))
        then, later = (model.slice_at(replace(make_views()[0], time=t)).rows.tolist() for t in (0.1, 0.4))
        assert then == [*range(before + count)]
        assert later == [*range(before), before + 1]

    def test_a_split_leaves_instants_and_lifetimes_as_they_are(self, kind: str) -> None:
        model = make_model(count=6, backbone=kind)
        model.gaussians.statistics["screen_gradient"].fill_(1.0)
        with torch.no_grad():
            model.gaussians["log_scales"].zero_()  # large ones are split, not cloned
        known = model.gaussians["times"].detach().clone()
        grow(model, model.settings.densify, torch.Generator().manual_seed(0))
        assert torch.equal(model.gaussians["times"], torch.cat([known, known]))
        assert len(model.gaussians["log_time_scales"].unique()) == 1

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

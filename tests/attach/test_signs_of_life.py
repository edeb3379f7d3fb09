"""Three lines are not silent: what is attached, progress now and then, a summary; to log, callback and writer."""

import logging
import math
import tomllib
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from mimics import fudan
from mimics.page import attached
from tiny import ALL_HOOKS, TinyFrames, TinyStore, make_adapter, make_model

from d2_plugin import D2Config, D2Hooks
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.config import DepthLossConfig
from d2_plugin.hooks import reports
from d2_plugin.hooks.reports import Report, RunLog


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("d2_plugin")]


def logged(config: D2Config, store: TinyStore | None = None, **how: object) -> Trainer:
    """A trainer of the tiny scene whose hooks log."""

    def attach(model: object) -> D2Hooks:
        return D2Hooks.from_config(config, make_adapter(model), store or TinyStore(), **how)

    return Trainer(make_model(), TinyFrames(), TrainSettings(iterations=30, seed=3), attach)


@pytest.mark.parametrize("pause", [0.0, math.inf])
@pytest.mark.usefixtures("workplace")
def test_the_printed_lines_say_what_happens_and_keep_their_distance(pause: float, caplog, monkeypatch) -> None:
    monkeypatch.setattr(reports, "PAUSE", pause)
    with caplog.at_level(logging.INFO):
        run = attached(fudan, "fudan").training(*fudan.make(), stop=16)
        run.d2.log.end()
    said = lines(caplog)
    first = next(line for line in said if line.startswith("attached by FudanAdapter to "))
    assert "priors of cameras cam0, cam1, cam2; densify 5 to 95 every 10, prune 5 to 90 every 10" in first
    assert sum("D2 renders depth with its own rasterizer" in line for line in said) == 1
    steps = [line for line in said if line.startswith("step ")]
    edits = {entry.step for entry in run.d2.trace if entry.action in ("insert", "remove") and entry.count}
    assert len(steps) == (1 if pause else len(edits))
    assert " inserted, " in steps[0]
    assert "depth_loss " in steps[0]
    assert said[-1] == run.d2.log.summary()
    inserted = sum(entry.count for entry in run.d2.trace if entry.action == "insert")
    assert said[-1].startswith(f"densify, prune, depth_loss: {inserted} inserted, ")


def test_a_callback_and_a_writer_get_every_change() -> None:
    reports: list[Report] = []
    scalars: dict[str, list[tuple[int, float]]] = defaultdict(list)
    writer = SimpleNamespace(add_scalar=lambda tag, value, step: scalars[tag].append((step, value)))
    trainer = logged(ALL_HOOKS, on_report=reports.append, writer=writer)
    trainer.run(29)
    assert scalars["d2/gaussians"][-1][1] == len(trainer.model)
    trainer.run()
    assert [report.step for report in reports] == list(range(1, 31))
    assert sum(report.inserted for report in reports) == trainer.d2.log.inserted > 0
    assert [step for step, _ in scalars["d2/depth_loss"]] == [10, 20, 30]
    assert all(value > 0 for _, value in scalars["d2/depth_loss"])


def test_a_camera_without_prior_is_warned_of_once_with_those_that_have_one(caplog) -> None:
    class OneCamera(TinyStore):
        cameras = ("cam0",)

        def prior(self, camera: str, frame: int):
            return super().prior(camera, frame) if camera == "cam0" else None

    trainer = logged(D2Config(depth_loss=ALL_HOOKS.depth_loss), OneCamera())
    trainer.d2.backbone.image = lambda camera: torch.zeros(3, camera.height, camera.width)
    trainer.run()
    assert not trainer.d2.prior.images  # nothing that waits for a prior that never comes
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warned) == 2
    for camera, line in zip(("cam1", "cam2"), sorted(warned), strict=True):
        assert line.startswith(f"camera {camera} has no prior at frame ")
        assert line.endswith("trained without D2 there; the prior has cameras cam0")


def test_a_trainer_that_counts_frames_from_one_is_told_which_frames_the_prior_has(caplog) -> None:
    class FromNought(TinyStore):
        cameras, frames = ("cam0", "cam1", "cam2"), [0]

        def prior(self, camera: str, frame: int):
            return super().prior(camera, frame) if frame in self.frames else None

    logged(D2Config(depth_loss=ALL_HOOKS.depth_loss), FromNought()).run()
    (line, *_) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert " at frame 1 and is" in line
    assert line.endswith("the prior has cameras cam0, cam1, cam2 at frames 0 to 0")


@pytest.mark.parametrize(("start", "stop", "warned"), [(15, 10, 1), (40, None, 1), (1, 2, 0)])
def test_a_hook_whose_schedule_has_no_step_is_named(start: int, stop: int | None, warned: int, caplog) -> None:
    D2Hooks(
        D2Config(depth_loss=DepthLossConfig(start=start, stop=stop), iterations=30),
        make_adapter(make_model()),
        TinyStore(),
    )
    assert caplog.text.count("depth_loss has no step: it starts at step") == warned


def test_a_loss_at_last_is_that_of_the_last_steps_where_nothing_was_read_in_between() -> None:
    run = RunLog({})
    run.start([], None, None, None, None)
    for step in range(1000):
        run.record_loss("depth_loss", torch.tensor(float(step < 500)))
    assert run.summary().endswith("depth_loss 1 at first, 0.00657 at last")


class TestSchedules:
    def test_the_length_of_the_run_sets_what_a_configuration_leaves_out(self) -> None:
        config = D2Config.from_dict({"prior": "x", "iterations": 30000, "densify": {"every": 50}, "prune": {}})
        assert (config.densify.start, config.densify.stop, config.densify.every) == (100, 15000, 50)
        assert config.prune.stop > 15000
        assert D2Config.from_dict({"prior": "x", "densify": {}}).densify.stop == 1500
        assert D2Config.from_dict(tomllib.loads(config.to_toml())) == config

    def test_the_trainer_says_its_length_in_the_first_line(self, workplace: Path) -> None:
        (workplace / "d2.toml").write_text('prior = "prior"\n[densify]\n')
        gaussians, scene = fudan.make()
        assert D2Hooks.attach("d2.toml", "fudan", gaussians, scene, iterations=400).config.densify.stop == 200

    def test_a_schedule_that_ends_early_is_warned_of(self, caplog) -> None:
        logged(ALL_HOOKS, iterations=30000)
        (warned,) = [line for line in lines(caplog) if "before a tenth of the run" in line]
        assert warned.startswith("densify and prune: over at step 30 of 30000")
        assert "write iterations = 30000 into the configuration" in warned
        caplog.clear()
        logged(ALL_HOOKS, iterations=100)
        assert not [line for line in lines(caplog) if "before a tenth" in line]

    @pytest.mark.parametrize(
        ("table", "iterations", "warned"),
        [
            ({"densify": {}, "depth_loss": {}}, None, ["densify: the length of the run is not known"]),
            ({"densify": {}}, 900, []),
            ({"densify": {}, "iterations": 900}, None, []),
            ({"densify": {"stop": 200}}, None, []),
            ({"depth_loss": {}}, None, []),
        ],
    )
    def test_a_default_schedule_without_the_length_of_the_run_is_warned_of(
        self, table: dict, iterations: int | None, warned: list[str], caplog
    ) -> None:
        d2 = D2Hooks.from_config(table, make_adapter(make_model()), TinyStore(), iterations=iterations)
        assert [line.partition(",")[0] for line in lines(caplog) if "default schedule" in line] == warned
        if iterations:
            assert d2.config.densify.stop == 450

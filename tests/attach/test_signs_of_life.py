"""Three lines are not silent: who is attached, what happens now and then, what came of it; and to whom it is told."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest
from mimics import fudan
from mimics.page import attached
from mimics.workplace import furnish
from tiny import ALL_HOOKS, TinyStore, make_trainer

from d2_plugin import D2Config, D2Hooks
from d2_plugin.hooks import reports
from d2_plugin.hooks.reports import Report


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return furnish(tmp_path, monkeypatch)


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("d2_plugin")]


def test_the_printed_lines_say_what_happens(workplace: Path, caplog, monkeypatch) -> None:
    monkeypatch.setattr(reports, "PAUSE", 0.0)
    with caplog.at_level(logging.INFO):
        run = attached(fudan, "fudan").training(*fudan.make())
        run.d2.telling.end()
    said = lines(caplog)
    first = next(line for line in said if line.startswith("attached by FudanAdapter to "))
    assert "priors of cameras cam0, cam1, cam2; densify 5 to 95 every 10, prune 5 to 90 every 10" in first
    assert any("D2 renders depth with its own rasterizer" in line for line in said)
    steps = [line for line in said if line.startswith("step ")]
    assert steps
    assert " inserted, " in steps[0]
    assert "depth_loss " in steps[0]
    assert said[-1] == run.d2.telling.summary()
    inserted = sum(entry.count for entry in run.d2.trace if entry.action == "insert")
    assert said[-1].startswith(f"densify, prune, depth_loss: {inserted} inserted, ")


def test_lines_of_progress_keep_their_distance(workplace: Path, caplog) -> None:
    with caplog.at_level(logging.INFO):
        attached(fudan, "fudan").training(*fudan.make())
    assert len([line for line in lines(caplog) if line.startswith("step ")]) == 1


def test_a_callback_and_a_writer_hear_of_every_change() -> None:
    class Writer:
        def __init__(self) -> None:
            self.scalars: dict[str, list[tuple[int, float]]] = {}

        def add_scalar(self, tag: str, value: float, step: int) -> None:
            self.scalars.setdefault(tag, []).append((step, value))

    heard: list[Report] = []
    writer, trainer = Writer(), make_trainer(ALL_HOOKS)
    trainer.d2.tell(on_report=heard.append, writer=writer)
    trainer.run()
    assert [report.step for report in heard] == list(range(1, 31))
    assert sum(report.inserted for report in heard) == trainer.d2.telling.inserted > 0
    assert writer.scalars["d2/gaussians"][-1][1] == len(trainer.model)
    assert [step for step, _ in writer.scalars["d2/depth_loss"]] == [10, 20, 30]
    assert all(value > 0 for _, value in writer.scalars["d2/depth_loss"])


def test_a_program_without_logging_hears_them_and_one_that_ends_gets_the_summary() -> None:
    """In a process of its own: under pytest the root logger has handlers."""
    code = (
        "from tiny import *\ntrainer = make_trainer(ALL_HOOKS)\ntrainer.d2.tell(iterations=30)\ntrainer.run()\n"
        "import sys; sys.stderr.write('end of the script\\n')"
    )
    tests = str(Path(__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], cwd=tests, capture_output=True, text=True, timeout=300)
    said = done.stderr.splitlines()
    assert done.returncode == 0, done.stderr
    assert said[0].startswith("d2: attached by Yang4DAdapter to 60 Gaussians")
    assert said[-2] == "end of the script"
    assert said[-1].startswith("d2: densify, prune, depth_loss: ")


def test_a_camera_without_prior_is_named_once(caplog) -> None:
    class OneCamera(TinyStore):
        def prior(self, camera: str, frame: int):
            return super().prior(camera, frame) if camera == "cam0" else None

    trainer = make_trainer(D2Config(depth_loss=ALL_HOOKS.depth_loss))
    trainer.d2._prior.store = OneCamera()
    with caplog.at_level(logging.INFO):
        trainer.run()
    said = [line.split(" at ")[0] for line in lines(caplog) if "trained without D2" in line]
    assert sorted(said) == ["camera cam1 has no prior", "camera cam2 has no prior"]


class TestSchedules:
    def test_the_length_of_the_run_sets_what_a_configuration_leaves_out(self) -> None:
        config = D2Config.from_dict({"prior": "x", "iterations": 30000, "densify": {"every": 50}, "prune": {}})
        assert (config.densify.start, config.densify.stop, config.densify.every) == (100, 15000, 50)
        assert config.prune.stop > 15000
        assert D2Config.from_dict({"prior": "x", "densify": {}}).densify.stop == 1500
        assert D2Config.from_dict({**config_as_read(config)}) == config

    def test_the_trainer_says_its_length_in_the_first_line(self, workplace: Path) -> None:
        (workplace / "d2.toml").write_text('prior = "prior"\n[densify]\n')
        gaussians, scene = fudan.make()
        d2 = D2Hooks.attach("d2.toml", "fudan", gaussians, scene, iterations=400)
        assert d2.config.densify.stop == 200

    def test_a_schedule_that_ends_early_is_said(self, caplog) -> None:
        trainer = make_trainer(ALL_HOOKS)
        trainer.d2.tell(iterations=30000)
        (said,) = [line for line in lines(caplog) if "before a tenth of the run" in line]
        assert said.startswith("densify and prune: over at step 30 of 30000")
        assert "write iterations = 30000 into the configuration" in said
        caplog.clear()
        make_trainer(ALL_HOOKS).d2.tell(iterations=100)
        assert not [line for line in lines(caplog) if "before a tenth" in line]

    def test_a_run_that_outlasts_its_schedule_without_a_word_is_said_once(self, caplog) -> None:
        trainer = make_trainer(ALL_HOOKS)
        trainer.d2.tell()
        for step in (299, 300, 301, 600):
            trainer.d2.telling.stepped(Report(step=step))
        assert len([line for line in lines(caplog) if "the last edit was due before step 30" in line]) == 1


def config_as_read(config: D2Config) -> dict:
    import tomllib

    return tomllib.loads(config.to_toml())

"""The table of benchmarks: each entry leads to its settings and to what runs them."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import BENCHMARKS
from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import begin_rows
from d2_plugin.settings import Settings, declared


@pytest.mark.parametrize("name", BENCHMARKS)
def test_each_benchmark_has_settings_with_help_and_something_that_runs_them(name: str) -> None:
    module = importlib.import_module(BENCHMARKS[name].module)
    settings = getattr(module, BENCHMARKS[name].settings)
    assert issubclass(settings, Settings)
    assert all(setting.help for setting in declared(settings))
    assert settings().output != Path()
    assert callable(module.run)


@pytest.mark.parametrize("words", [["stability"], ["bench", "training-step"], ["bench", "scaling"]])
def test_a_place_for_rows_that_cannot_be_is_said_before_anything_is_measured(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.set_num_threads", lambda count: None)
    (tmp_path / "thesis.tex").write_text("mine")
    for name, says in (("thesis.tex", "is no file of rows"), ("thesis.tex/x.jsonl", "cannot"), (".", "is a folder")):
        assert main([*words, "--output", str(tmp_path / name)]) == 2
        assert says in capsys.readouterr().err
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_rows_can_begin_where_nothing_is(tmp_path: Path) -> None:
    begin_rows(tmp_path / "new" / "runs.jsonl")
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "runs.jsonl").write_text('{"kind": "step"}\n')
    begin_rows(tmp_path / "runs.jsonl")
    assert (tmp_path / "runs.jsonl").read_text() == '{"kind": "step"}\n'


def test_the_table_is_read_without_importing_torch() -> None:
    code = "import sys, benchmarks; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def test_a_step_too_small_to_be_measured_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks import training_step

    monkeypatch.setattr(training_step, "timed", lambda *_: {training_step.RASTER: {"cpu_ms": 0.0}})
    with pytest.raises(D2Error, match="took no CPU time that can be measured: give more --gaussians"):
        training_step.measure(training_step.StepCase(5, 16, 16, 1), 0.0, memory=False)

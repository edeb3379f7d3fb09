"""Every `d2` command as a person meets it: its help, its flags, tables given by flags, and what it says at work."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import form_of
from stand_in_recordings import renamed

from d2_plugin import progress
from d2_plugin.backbones import yang4d
from d2_plugin.commands.arguments.form import Given
from d2_plugin.commands.arguments.recording import hook_names
from d2_plugin.commands.cli import COMMANDS, main
from d2_plugin.config import DensifyConfig
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import hook_config, prior_settings

CAMERAS = ["--train-cameras", "train0,train1,train2"]


def parsed(command: str, *words: str) -> Given:
    rest = list(words)
    return form_of(command, rest).parse(rest)


def test_d2_help_imports_neither_torch_nor_numpy() -> None:
    code = (
        "import sys; from d2_plugin.commands.cli import main\n"
        "for words in (['--help'], ['--version'], ['trian'], []): main(words)\n"
        "print('heavy:', *({'torch', 'numpy', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].strip() == "heavy:"


class TestHelp:
    def test_every_command_stands_there_with_a_sentence(self, answered) -> None:
        lines = answered("--help").splitlines()
        for name in COMMANDS:
            [line] = [line for line in lines if line.startswith(f"  {name} ")]
            assert len(line.split()) > 5

    @pytest.mark.parametrize("command", [name for name in COMMANDS if name != "bench"])
    def test_every_command_explains_each_of_its_settings_and_those_of_its_tables(self, command: str, answered) -> None:
        assert answered(command, "--help").startswith(f"usage: d2 {command}")
        form = form_of(command, [])
        for settings in (form.settings, *(section.settings for section in form.sections([]).values())):
            assert not [setting.name for setting in settings if not setting.help], f"{command}: no docstring"

    def test_train_shows_tables_with_a_line_each_and_one_on_demand(self, answered) -> None:
        short = answered("train", "--help")
        assert len(short.splitlines()) <= 80
        assert "--priors.stereo.*" in short
        assert "budget-per-view" not in short
        table = answered("train", "--help", "densify")
        assert "--densify.budget-per-view N" in table
        assert "they lie further apart instead" in " ".join(table.split())
        assert f"default {DensifyConfig().budget_per_view}" in table
        assert "--backbone.hexplane." in answered("train", "--help-all", "--backbone", "deform")

    def test_bench_measures_runs_everywhere_and_other_parts_in_a_checkout(
        self, capsys, answered, refused, tmp_path, monkeypatch
    ) -> None:
        assert "d2 bench training" in answered("bench", "training", "--help")
        assert main(["bench", "raster", "--help"]) == 0, "this is a checkout"
        assert "python -m benchmarks raster" in capsys.readouterr().out
        assert "did you mean 'training'?" in refused("bench", "trainng")
        monkeypatch.setattr("d2_plugin.__file__", str(tmp_path / "site-packages" / "d2_plugin" / "__init__.py"))
        assert "'raster' is measured from a checkout alone" in refused("bench", "raster")


class TestTables:
    def test_hooks_that_are_named_in_another_order_are_the_same_run(self) -> None:
        assert hook_names("prune,densify, prune") == hook_names("densify,prune")
        assert hook_names("parallax,motion,depth_loss,prune,densify,prior") == hook_names("all")

    def test_flags_stand_over_the_file_and_the_file_over_the_defaults(self, recording, tmp_path, capsys) -> None:
        config = tmp_path / "d2.toml"
        config.write_text(
            "[densify]\nbudget_per_view = 7\nopacity = 0.2\n[priors]\ntau_c = 0.05\n[priors.stereo]\nmin_angle = 3.0\n"
        )
        flags = "--densify.budget-per-view 500 --priors.stereo.min-angle 2 --backbone.sh-degree 1 --plan.temporal false"
        words = [str(recording), *CAMERAS, "--config", str(config), *flags.split(), "--d2.retire-after", "0"]
        words += ["--training.ssim-weight", "0.5"]
        output = tmp_path / "run"
        assert main(["train", *words, "--iterations", "4", "--hooks", "none", "--output", str(output)]) == 0
        assert "note  --densify.* changes nothing: --hooks leaves densify out" in capsys.readouterr().out
        settings = Run.load(output).settings
        densify = hook_config(replace(settings, hooks=("densify",)), tmp_path).densify
        assert (densify.budget_per_view, densify.opacity) == (500, 0.2)
        assert densify.tau_v == DensifyConfig().tau_v
        prior = prior_settings(settings)
        assert (prior.stereo.min_angle, prior.tau_c) == (2.0, 0.05)
        assert (settings.overrides["backbone"], settings.overrides["d2"]) == ({"sh_degree": 1}, {"retire_after": 0})
        assert Run.load(output).trained().settings == yang4d.TrainSettings(iterations=4, ssim_weight=0.5)
        metrics = json.loads((output / "metrics.json").read_text())
        assert metrics["plan"]["temporal"]["use"] is False

    def test_the_tables_of_a_backbone_are_those_of_the_chosen_one(self, refused) -> None:
        words = ["room", *CAMERAS, "--output", "x"]
        given = parsed("train", *words, "--backbone", "deform", "--backbone.seed", "3")
        assert given.tables == {"backbone": {"seed": 3}}
        assert "did you mean --backbone.sh-time-degree?" in refused("train", *words, "--backbone.sh-time-degre", "1")
        assert "unknown flag --backbone.sh-time-degree" in refused(
            "train", *words, "--backbone", "deform", "--backbone.sh-time-degree", "1"
        )


def test_a_preset_passes_over_a_camera_without_calibration_and_so_does_the_run(
    tmp_path: Path, capsys, answered
) -> None:
    rendered = synthetic_recording(cameras=3, held_out=1, frames=2, width=48, height=27)
    room = save_recording(renamed(rendered, ("cam01", "cam13", "cam10", "cam00")), tmp_path / "room")
    shutil.copytree(room / "images" / "cam01", room / "images" / "cam07")  # images without calibration
    words = ["--train-cameras", "preset:2", "--iterations", "4", "--hooks", "none", "--output", str(tmp_path / "run")]
    assert "missing: cam07" in answered("train", str(room), *words)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["train_cameras"], metrics["test_cameras"]) == (["cam01", "cam13"], ["cam10", "cam00"])
    assert main(["plan", str(room), "--train-cameras", "cam01,cam13"]) == 2  # no preset: whatever does not fit is named
    assert "cam07" in capsys.readouterr().err


def test_the_time_left_is_that_of_the_work_not_of_what_began_it(monkeypatch, capsys) -> None:
    """Workers that take 40 s to start, then a unit a second: 65 s are left for 65 units, not five minutes."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr(progress, "_silent", False)
    with progress.progress_bar("between", 76) as bar:
        for done in range(1, 77):
            now = 39.0 + done
            bar.update(done)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["between: 1/76 ", "between: 11/76, 65 s left "]
    assert lines[-1] == "between: 76/76, 0 s left "

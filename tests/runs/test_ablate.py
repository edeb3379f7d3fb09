"""`d2 ablate`: the rows are the paper's, seeds are averaged, and a finished run is never repeated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import VARIANTS
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.ablation import tables
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, rows_named
from d2_plugin.runs.settings import RunSettings, check, hook_config, prior_settings
from d2_plugin.runs.shared import Job
from d2_plugin.runs.verdict import EXPLANATION


def settings_of(name: str, recording: str = "room", **tables: object) -> RunSettings:
    preset = PRESETS[name]
    return RunSettings(recording, ("a",), hooks=preset.hooks, overrides=preset.merged(tables))


class TestPresets:
    def test_a_row_that_two_tables_share_is_run_once(self) -> None:
        names = [preset.name for preset in rows_named(["ablation", "pruning", "full"])]
        assert len(names) == len(set(names)) == 12

    def test_unknown_row_is_answered_with_the_nearest(self) -> None:
        with pytest.raises(D2Error, match="no_pruning"):
            rows_named(["no_prunning"])

    @pytest.mark.parametrize("name", PRESETS)
    def test_every_preset_is_accepted_by_the_settings_check(self, name: str) -> None:
        check(settings_of(name))

    def test_prior_rows_differ_in_the_prior_alone(self) -> None:
        rows = TABLES["ablation"][1:5]
        assert {prior_settings(settings_of(name)).variant for name in (*rows, "full")} == set(VARIANTS)
        assert {PRESETS[name].hooks for name in rows} == {PRESETS["full"].hooks}

    def test_single_signals_put_all_weight_on_one_term(self) -> None:
        weights = [
            config.lambda_e
            for name in ("opacity_only", "depth_only", "full")
            if (config := hook_config(settings_of(name), Path("prior")).prune)
        ]
        assert weights == [0, 1, 0.5]

    def test_the_users_tables_stay_below_the_presets(self) -> None:
        mine = {"prune": {"tau_p": 0.9, "lambda_e": 0.4}, "backbone": {"densify": {"every": 50}}}
        merged = PRESETS["depth_only"].merged(mine)
        assert merged["prune"] == {"tau_p": 0.9, "lambda_e": 1.0}
        assert PRESETS["full_d2_densification_only"].merged(mine)["backbone"] == {
            "densify": {"every": 50, "enabled": False}
        }
        assert mine["prune"]["lambda_e"] == 0.4


def results(**psnr: list[float]) -> dict[Job, dict]:
    """Metrics of made-up runs, one per seed."""

    def metrics(value: float) -> dict:
        scores = {"psnr": value, "ssim1": 0.9, "ssim2": 0.95, "lpips": None, "depth_absrel": 0.04}
        seconds = {"train": 10.0, "priors": 2.0}
        return {"test": scores, "gaussians": 1000, "seconds": seconds, "iterations": 5, "recording": "room"} | {
            "train_cameras": ["a", "b"]
        }

    return {
        Job(name, replace(settings_of(name), seed=seed), Path()): metrics(value)
        for name, values in psnr.items()
        for seed, value in enumerate(values)
    }


def order(**psnr: list[float]) -> dict[str, str]:
    """What is said of PSNR, by the title of the other row."""
    return {cells[0]: cells[1] for cells in tables.order_table(results(**psnr), "yang4d").rows}


class TestTables:
    def test_a_cell_is_mean_and_standard_error(self) -> None:
        text = tables.table(results(full=[28.0, 30.0]), "yang4d", ["full"])
        assert "| D²-4DGS | two seeds | 29.00 ± 1.00 |" in text  # the sample deviation, 1.41, over sqrt(2)
        assert "| - |" in text  # LPIPS was not measured
        assert "| D²-4DGS | 3 | 29.00 ± 0.58 |" in tables.table(results(full=[28.0, 29.0, 30.0]), "yang4d", ["full"])

    def test_one_seed_says_so_and_has_no_error(self) -> None:
        text = tables.table(results(full=[28.0]), "yang4d", ["full"])
        assert "| D²-4DGS | one seed | 28.00 |" in text
        assert "±" not in text

    def test_latex_has_a_row_per_variant(self) -> None:
        text = tables.table(
            results(full=[28.0, 30.0], backbone=[25.0, 26.0]), "yang4d", ["backbone", "full"], as_latex=True
        )
        assert text.count(r"\pm") == 2 * 6
        assert r"D$^2$-4DGS & two seeds & $29.00 \pm 1.00$" in text

    def test_an_order_that_fails_is_said_with_its_margin(self) -> None:
        found = order(full=[28.0, 28.1, 27.9], backbone=[25.0, 25.1, 24.9], no_pruning=[28.5, 28.6, 28.4])
        assert found["Backbone"] == "holds (+3.00 ± 0.08 dB)"
        assert found["w/o Pruning"] == "fails (-0.50 ± 0.08 dB)"
        assert len(found) == 2  # nothing is claimed about rows that were not run

    def test_an_order_within_the_spread_of_the_seeds_is_undecided(self) -> None:
        found = order(full=[28.0, 29.0, 30.0], backbone=[25.0, 25.05, 25.1], no_pruning=[29.3, 29.5, 29.4])
        assert found["Backbone"].startswith("holds")
        assert found["w/o Pruning"] == "undecided (-0.40 ± 0.58 dB)"  # sqrt(1 / 3 + 0.01 / 3)

    def test_fewer_than_three_seeds_give_no_verdict_however_large_the_margin(self) -> None:
        alone = order(full=[28.001], backbone=[28.0])
        assert alone["Backbone"] == "one seed: no verdict (+0.00 dB)"
        pair = order(full=[40.0, 40.1], backbone=[20.0, 20.1, 20.2])
        assert pair["Backbone"].startswith("two seeds: no verdict")
        made = tables.report(results(full=[28.001], backbone=[28.0]), rows_named(["full", "backbone"]))
        assert "holds" not in made.replace(EXPLANATION, "")

    def test_each_metric_has_a_verdict_of_its_own(self) -> None:
        runs = results(full=[28.0, 28.1, 27.9], mvs_only=[25.0, 25.1, 24.9])
        for job, metrics in runs.items():
            metrics["test"]["ssim1"] = (0.8 if job.preset == "full" else 0.9) + 0.001 * job.settings.seed
            metrics["test"]["depth_absrel"] = (0.03 if job.preset == "full" else 0.05) + 0.001 * job.settings.seed
        [row] = tables.order_table(runs, "yang4d").rows
        assert [cell.split()[0] for cell in row[1:]] == ["holds", "fails", "no", "holds"]
        assert tables.order_table(runs, "yang4d").header[1:] == ("PSNR", "SSIM1", "SSIM2", "depth AbsRel")

    def test_the_papers_own_figures_stand_beside_labelled(self) -> None:
        made = results(**{name: [28.0] for name in TABLES["pruning"]})
        text = tables.report(made, rows_named(["pruning"]))
        assert "○ paper's PSNR" in text
        assert "| 22.21 |" in text
        assert "not measured here" in text


def test_the_command_trains_shares_priors_and_repeats_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    recording = save_recording(
        synthetic_recording(cameras=3, held_out=1, frames=2, width=96, height=54), tmp_path / "recordings" / "room"
    )
    command = ["ablate", str(recording), "--train-cameras", "train0,train1,train2", "--rows", "main,no_pruning"]
    command += ["--seeds", "0,1", "--iterations", "20", "--jobs", "1", "--output", str(tmp_path / "out")]
    assert main(command) == 0
    table = (tmp_path / "out" / "ablation.md").read_text()
    assert "| Backbone |" in table
    assert "| w/o Pruning |" in table
    assert {path.name for path in (tmp_path / "out" / "priors").iterdir()} == {"dual", "dual.seconds.json"}, "one"
    rows = [json.loads(line) for line in (tmp_path / "out" / "runs.jsonl").read_text().splitlines()]
    assert len(rows) == 6
    assert all(row["kind"] == "ablation" and row["error"] > 0 for row in rows)
    assert [row["prior_seconds"] > 0 for row in rows] == [False, False, True, True, True, True]
    checkpoints = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("checkpoint.pt")}
    assert len(checkpoints) == 6
    assert main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in checkpoints} == checkpoints
    capsys.readouterr()
    assert main([*command, "--iterations", "21"]) == 2
    assert "another run" in capsys.readouterr().err

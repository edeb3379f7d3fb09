"""`d2 ablate`: the rows are the paper's, seeds are averaged, and a finished run is never repeated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from d2_plugin.captures.export.folder import save_capture
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import VARIANTS
from d2_plugin.runs.settings import RunSettings, check, hook_config, prior_settings
from d2_plugin.study.ablation import ablate
from d2_plugin.study.ablation.presets import PRESETS, TABLES, rows_named


def settings_of(name: str, capture: str = "room", **tables: object) -> RunSettings:
    preset = PRESETS[name]
    return RunSettings(capture, ("a",), hooks=preset.hooks, overrides=preset.merged(tables))


class TestPresets:
    def test_every_row_of_the_paper_is_there(self) -> None:
        assert len(TABLES["ablation"]) == 10  # the paper's nine and one of ours
        assert TABLES["pruning"] == ("no_pruning", "opacity_only", "depth_only", "full")

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
            (config.lambda_e, config.lambda_o)
            for name in ("opacity_only", "depth_only", "full")
            if (config := hook_config(settings_of(name), Path("prior")).prune)
        ]
        assert weights == [(0, 1), (1, 0), (0.5, 0.5)]

    def test_the_users_tables_stay_below_the_presets(self) -> None:
        mine = {"prune": {"tau_p": 0.9, "lambda_e": 0.4, "lambda_o": 0.6}, "backbone": {"densify": {"every": 50}}}
        merged = PRESETS["depth_only"].merged(mine)
        assert merged["prune"] == {"tau_p": 0.9, "lambda_e": 1.0, "lambda_o": 0.0}
        assert PRESETS["full_d2_densification_only"].merged(mine)["backbone"] == {
            "densify": {"every": 50, "enabled": False}
        }
        assert mine["prune"]["lambda_e"] == 0.4


def results(**psnr: list[float]) -> dict[ablate.Job, dict]:
    """Metrics of made-up runs, one per seed."""

    def metrics(value: float) -> dict:
        scores = {"psnr": value, "ssim1": 0.9, "ssim2": 0.95, "lpips": None, "depth_absrel": 0.04}
        seconds = {"train": 10.0, "priors": 2.0}
        return {"test": scores, "gaussians": 1000, "seconds": seconds, "iterations": 5, "capture": "room"} | {
            "train_cameras": ["a", "b"]
        }

    return {
        ablate.Job(name, "yang4d", seed, settings_of(name), Path()): metrics(value)
        for name, values in psnr.items()
        for seed, value in enumerate(values)
    }


class TestTables:
    def test_a_cell_is_mean_and_sample_deviation(self) -> None:
        text = ablate.table(results(full=[28.0, 30.0]), "yang4d", ["full"])
        assert "| D²-4DGS | 29.00 ± 1.41 |" in text
        assert "| - |" in text  # LPIPS was not measured

    def test_latex_has_a_row_per_variant(self) -> None:
        text = ablate.table(
            results(full=[28.0, 30.0], backbone=[25.0, 26.0]), "yang4d", ["backbone", "full"], latex=True
        )
        assert text.count(r"\pm") == 2 * 6
        assert r"D$^2$-4DGS & $29.00 \pm 1.41$" in text

    def test_an_order_that_fails_is_said_with_its_margin(self) -> None:
        found = {
            c.sentence: c for c in ablate.claims(results(full=[28.0], backbone=[25.0], no_pruning=[28.5]), "yang4d")
        }
        assert found["D²-4DGS is above Backbone"].margin == pytest.approx(3)
        assert str(found["D²-4DGS is above w/o Pruning"]).startswith("- fails")
        assert len(found) == 2  # nothing is claimed about rows that were not run

    def test_an_order_within_the_spread_of_the_seeds_is_undecided(self) -> None:
        found = ablate.claims(
            results(full=[28.0, 29.0, 30.0], backbone=[25.0, 25.1], no_pruning=[29.3, 29.5]), "yang4d"
        )
        assert [claim.verdict for claim in found] == ["holds", "undecided"]
        assert found[1].error == pytest.approx((1 / 3 + 0.02 / 2) ** 0.5)

    def test_the_papers_own_figures_stand_beside_labelled(self) -> None:
        made = results(**{name: [28.0] for name in TABLES["pruning"]})
        text = ablate.report(made, rows_named(["pruning"]))
        assert "○ paper's PSNR" in text
        assert "| 22.21 |" in text
        assert "not measured here" in text

    def test_statistics_leave_out_what_was_not_measured(self) -> None:
        assert ablate.statistics([None, 2.0, None]) == (2.0, 0.0)
        assert ablate.statistics([None]) is None


def test_the_command_trains_shares_priors_and_repeats_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    capture = save_capture(
        synthetic_capture(cameras=3, held_out=1, frames=2, width=96, height=54), tmp_path / "captures" / "room"
    )
    command = ["ablate", str(capture), "--train-cameras", "train0,train1,train2", "--rows", "main,no_pruning"]
    command += ["--seeds", "0,1", "--iterations", "20", "--jobs", "1", "--output", str(tmp_path / "out")]
    assert main(command) == 0
    table = (tmp_path / "out" / "ablation.md").read_text()
    assert "| Backbone |" in table
    assert "| w/o Pruning |" in table
    assert {path.name for path in (tmp_path / "out" / "priors").iterdir()} == {"dual", "dual.seconds.json"}
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

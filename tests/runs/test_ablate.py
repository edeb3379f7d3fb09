"""`d2 ablate`: the rows are the paper's, seeds are averaged, and a finished run is never repeated."""

import json
import shutil

import pytest
from at_once import measured_at_once
from refusals import refuses
from stand_in_recordings import write_grey

from d2_plugin.commands.cli import main
from d2_plugin.durable import append
from d2_plugin.runs.ablation.ablate import order_table, report, table
from d2_plugin.runs.ablation.presets import PRESETS, TABLES, rows_named
from d2_plugin.runs.settings import RunSettings, check
from d2_plugin.runs.verdict import EXPLANATION
from d2_plugin.viewing.viewed import viewed_run


class TestPresets:
    def test_a_row_that_two_tables_share_is_run_once(self) -> None:
        names = [preset.name for preset in rows_named(["ablation", "pruning", "full"])]
        assert len(names) == len(set(names)) == 12
        refuses("no_pruning", rows_named, ["no_prunning"])
        refuses("unknown table or preset ''", rows_named, [])

    @pytest.mark.parametrize("name", PRESETS)
    def test_every_preset_is_accepted_by_the_settings_check(self, name: str) -> None:
        check(RunSettings("room", ("a",), hooks=PRESETS[name].hooks, overrides=PRESETS[name].merged({})))

    def test_the_users_tables_stay_below_the_presets(self) -> None:
        mine = {"prune": {"tau_p": 0.9, "lambda_e": 0.4}, "backbone": {"densify": {"every": 50}}}
        assert PRESETS["depth_only"].merged(mine)["prune"] == {"tau_p": 0.9, "lambda_e": 1.0}
        merged = PRESETS["full_d2_densification_only"].merged(mine)
        assert merged["backbone"] == {"densify": {"every": 50, "enabled": False}}
        assert mine["prune"]["lambda_e"] == 0.4


def rows_of(**psnr: list[float]) -> dict[str, list[dict]]:
    """Rows of made-up runs by preset, one per seed."""

    def row(name: str, value: float) -> dict:
        scores = {"psnr": value, "ssim1": 0.9, "ssim2": 0.95, "lpips": None, "depth_absrel": 0.04}
        return {"method": f"yang4d {name}", "scores": scores, "gaussians": 1000, "seconds": 10.0}

    return {name: [row(name, value) for value in values] for name, values in psnr.items()}


class TestTables:
    @pytest.mark.parametrize(
        ("psnr", "cells"),
        [
            ([28.0], "one seed | 28.00"),
            ([28.0, 30.0], "two seeds | 29.00 ± 1.00"),  # the sample deviation, 1.41, over sqrt(2)
            ([28.0, 29.0, 30.0], "3 | 29.00 ± 0.58"),
        ],
    )
    def test_a_cell_is_mean_and_standard_error(self, psnr: list[float], cells: str) -> None:
        text = table(rows_of(full=psnr))
        assert f"| D²-4DGS | {cells} |" in text
        assert "| - |" in text, "LPIPS was not measured"

    @pytest.mark.parametrize(
        ("full", "backbone", "verdict"),
        [
            ([28.0, 28.1, 27.9], [25.0, 25.1, 24.9], "holds (+3.00 ± 0.08 dB)"),
            ([28.0, 28.1, 27.9], [28.5, 28.6, 28.4], "fails (-0.50 ± 0.08 dB)"),
            ([28.0, 29.0, 30.0], [29.3, 29.5, 29.4], "undecided (-0.40 ± 0.58 dB)"),  # sqrt(1 / 3 + 0.01 / 3)
            ([28.001], [28.0], "one seed: no verdict (+0.00 dB)"),
            ([40.0, 40.1], [20.0, 20.1, 20.2], "two seeds: no verdict (+19.95 ± 0.08 dB)"),
        ],
    )
    def test_a_verdict_needs_three_seeds_and_two_standard_errors(self, full, backbone, verdict) -> None:
        [cells] = order_table(rows_of(full=full, backbone=backbone)).rows
        assert cells[:2] == ("Backbone", verdict)

    def test_a_run_that_failed_is_no_seed_and_says_why(self) -> None:
        rows = rows_of(backbone=[20.0, 21.0, 22.0])["backbone"]
        rows[0] |= {"scores": None, "gaussians": None, "setting": "8 steps, seed 0", "failed": "it diverged"}
        text = report(rows, rows_named(["backbone"]))
        assert "| Backbone | two seeds | 21.50 ± 0.50 |" in text
        assert "yang4d backbone, 8 steps, seed 0 has no score: it diverged." in text

    def test_the_papers_own_figures_stand_beside_labelled(self) -> None:
        rows = rows_of(**{name: [28.0] for name in TABLES["pruning"]})
        text = report([row for mine in rows.values() for row in mine], rows_named(["pruning"]))
        assert "○ paper's PSNR" in text
        assert "| 22.21 |" in text
        assert "not measured here" in text
        assert "holds" not in text.replace(EXPLANATION, "")


def test_the_command_trains_shares_priors_and_repeats_nothing(saved_room, tmp_path, refused, monkeypatch) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    room = shutil.copytree(saved_room(cameras=2, held_out=1, frames=2, width=96, height=54), tmp_path / "room")
    command = ["ablate", str(room), "--train-cameras", "train0,train1", "--rows", "main,no_pruning"]
    command += ["--seeds", "3,3", "--iterations", "8", "--jobs", "1", "--output", str(tmp_path / "out")]
    written = tmp_path / "out" / "runs.jsonl"

    def append_and_stop(*given) -> None:
        append(*given)
        raise KeyboardInterrupt

    with measured_at_once(), monkeypatch.context() as patch:
        patch.setattr("d2_plugin.runs.rows.append", append_and_stop)
        assert main(command) == 130
        first = written.read_text()
        assert first.count("\n") == 1
    with measured_at_once():
        assert main(command) == 0
    assert written.read_text().startswith(first)
    table = (tmp_path / "out" / "ablation.md").read_text()
    assert "| Backbone | one seed |" in table, "a seed that is named twice is one"
    assert "| w/o Pruning |" in table
    assert {path.name for path in (tmp_path / "out" / "priors").iterdir()} == {"dual", "dual.seconds.json"}, "one"
    rows = [json.loads(line) for line in written.read_text().splitlines()]
    assert len(rows) == 3
    assert all(row["kind"] == "ablation" and row["error"] > 0 for row in rows)
    assert [row["prior_seconds"] > 0 for row in rows] == [False, True, True]
    checkpoints = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("checkpoint.pt")}
    assert len(checkpoints) == 3
    with measured_at_once():
        assert main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in checkpoints} == checkpoints
    assert [json.loads(line) for line in written.read_text().splitlines()] == rows
    assert "another run" in refused(*command, "--iterations", "9")
    for path in (room / "images" / "train0").iterdir():
        write_grey(path, 99, (96, 54))  # another recording in a folder of the same name
    assert "holds a run of `d2 train`: give" in refused(*command[:-1], str(next(iter(checkpoints)).parent))
    assert "of another frames, recording: give" in refused(*command, "--rows", "no_rgbd", "--frames", "0")


def test_an_ablation_goes_on_where_it_and_its_recording_were_moved(saved_room, tmp_path, refused, monkeypatch) -> None:
    shutil.copytree(saved_room(cameras=2, held_out=1, frames=2, width=96, height=54), tmp_path / "old" / "room")
    command = ["ablate", "room", "--train-cameras", "train0,train1", "--rows", "main", "--iterations", "2"]
    command += ["--jobs", "1", "--output", "out", "--seeds"]
    monkeypatch.chdir(tmp_path / "old")
    with measured_at_once():
        assert main([*command, "0"]) == 0
    moved = shutil.move(tmp_path / "old", tmp_path / "new")
    monkeypatch.chdir(moved)
    with measured_at_once():
        assert main([*command, "0,1"]) == 0
    rows = (moved / "out" / "runs.jsonl").read_text().splitlines()
    assert [json.loads(row)["seed"] for row in rows] == [0, 0, 1, 1]
    assert viewed_run(moved / "out" / "yang4d" / "full" / "seed0").store is not None, "run.json says where they are now"
    monkeypatch.chdir(shutil.copytree(moved, tmp_path / "copy"))
    assert "other settings of priors, recording: give" in refused(*command, "0"), "what is still there was not moved"


def test_without_a_camera_held_out_nothing_is_trained(saved_room, tmp_path, refused) -> None:
    room = saved_room(cameras=2, held_out=1, frames=2, width=96, height=54)
    said = refused("ablate", str(room), "--train-cameras", "all", "--output", str(tmp_path / "out"))
    assert "leave one out of --train-cameras" in said
    said = refused("bench", "training", f"{room}@all", "--output", str(tmp_path / "out"))
    assert "@all' train, so no run can be scored: leave one out" in said
    assert not (tmp_path / "out").exists()

"""`d2 plan --verify` takes each decision both ways; `d2 bench scaling` tells growth; memory is the work's alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import scaling as bench_scaling
from benchmarks.memory import Measured, in_fresh_process
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs import memory, plan_verify
from d2_plugin.runs.plan_verify import LEFT_OUT, USED, PlanVerification, questions, table, verify
from d2_plugin.runs.rows import Row, make_row
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings, check

LINUX = pytest.mark.skipif(not memory._RESET.exists(), reason="peak memory is measured on Linux")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two training cameras, one held out, three frames of things that move."""
    path = tmp_path_factory.mktemp("room")
    save_recording(synthetic_recording(2, 1, frames=3, width=96, height=54, arc_degrees=15), path)
    return path


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work that would get a process of its own runs in this one."""

    def run(work: Callable[..., Any], *arguments: Any) -> Measured:
        return Measured(work(*arguments), 1.0)

    monkeypatch.setattr(plan_verify, "in_fresh_process", run)
    monkeypatch.setattr(bench_scaling, "in_fresh_process", run)


def asked(room: Path, *cameras: str, **more: Any) -> dict[str, plan_verify.Question]:
    settings = check(RunSettings(str(room), cameras, **more))
    return {question.name: question for question in questions(settings, Scene.open(settings), 2)}


def test_each_decision_differs_in_that_decision_alone(room: Path) -> None:
    found = asked(room, "train0", "train1")
    temporal = found["temporal dimension"].settings
    assert [temporal[way].overrides["plan"] for way in (USED, LEFT_OUT)] == [{"temporal": True}, {"temporal": False}]
    assert temporal[USED].hooks == temporal[LEFT_OUT].hooks == ()
    reuse = found["matching static pixels again"].settings
    assert reuse[USED].overrides["priors"]["stereo"] == {"reuse_static": False}
    assert reuse[LEFT_OUT].overrides == {}
    assert reuse[USED].frames == reuse[LEFT_OUT].frames == (0, 1)
    retiring = found["hooks that change nothing"].settings
    assert retiring[USED].overrides["d2"] == {"retire_after": 0}
    assert retiring[USED].hooks == retiring[LEFT_OUT].hooks


def test_what_cannot_be_taken_the_other_way_says_why(room: Path) -> None:
    found = asked(room, "train0")
    assert found["stereo"].planned == "left out: one training camera"
    assert found["stereo"].settled == "it cannot be used: there is no second point of view"
    assert found["matching static pixels again"].settled == "there is no second frame or no stereo"
    instant = asked(room, "train0", "train1", frames=(1,))
    assert instant["temporal dimension"].planned == "left out: one instant"
    assert instant["matching static pixels again"].settled is not None


def test_verification_measures_both_ways_and_the_cost_of_leaving_out(room: Path, here: None) -> None:
    rows = verify(RunSettings(str(room), ("train0", "train1")), iterations=4, prior_frames=2, seeds=(0, 1))
    by = {(row["method"], row["setting"]): row for row in rows}
    assert by["stereo", "-"]["failed"].startswith("geometric depth is half of the method")
    for name in ("temporal dimension", "matching static pixels again", "hooks that change nothing"):
        used, left_out = by[name, USED], by[name, LEFT_OUT]
        assert used["cost"] == 0
        lost = [a["score"] - b["score"] for a, b in zip(used["details"], left_out["details"], strict=True)]
        assert left_out["cost"] == left_out["error"] == pytest.approx(np.mean(lost))
        assert (left_out["cost_deviation"] is None) == (len(lost) == 1)
        assert min(used["seconds"], left_out["seconds"]) > 0
    assert by["matching static pixels again", LEFT_OUT]["details"][0]["median_error"] < 0.05
    assert by["temporal dimension", USED]["gaussians"] > 0
    assert len(by["temporal dimension", USED]["details"]) == 2
    text = table(rows)
    assert "| temporal dimension | used: motion" in text
    assert "dB held out | two seeds: no verdict |" in text


def plan_rows(*costs: float) -> list[Row]:
    """A decision that was taken both ways, with the cost of leaving the part out for each seed."""
    spread = float(np.std(costs, ddof=1)) if len(costs) > 1 else None
    about = {"planned": "used: motion", "unit": "dB held out", "seconds": 1.0, "seeds": list(range(len(costs)))}
    used = make_row("plan", "room", "temporal", USED, error=0.0, cost=0.0, cost_deviation=0.0, **about)
    mean = float(np.mean(costs))
    return [used, make_row("plan", "room", "temporal", LEFT_OUT, error=mean, cost=mean, cost_deviation=spread, **about)]


@pytest.mark.parametrize(
    ("costs", "verdict"),
    [
        ((0.001,), "one seed: no verdict"),
        ((2.0, 2.1), "two seeds: no verdict"),
        ((2.0, 2.1, 1.9), "costs"),
        ((-2.0, -2.1, -1.9), "gains"),
        ((1.0, -0.9, 0.3), "undecided"),
        ((0.0, 0.0, 0.0), "no difference"),
    ],
)
def test_a_decision_has_a_verdict_from_three_seeds_on(costs: tuple[float, ...], verdict: str) -> None:
    assert table(plan_rows(*costs)).splitlines()[-1].endswith(f"| {verdict} |")


def test_the_recorded_command_is_the_one_that_makes_the_rows() -> None:
    settings = PlanVerification("/data/room", ("a", "b"), (0, 2, 4), mono_kind="metric", output=Path("/mnt/rows.jsonl"))
    words = "d2 plan --verify room --train-cameras a,b --frames 0:4:2 --mono-kind metric --output rows.jsonl"
    assert plan_verify._command(settings) == words


def test_scaling_rows_tell_time_and_memory_per_length(here: None, tmp_path: Path) -> None:
    rows = bench_scaling.bench_scaling((1, 2), width=96, iterations=2, command="d2 bench scaling")
    assert [(row["method"], row["frames"]) for row in rows] == [
        *(("priors", 1), ("training", 1)),
        *(("priors", 2), ("training", 2)),
    ]
    assert all(row["seconds"] > 0 and row["kind"] == "scaling" for row in rows)
    assert json.dumps(rows, allow_nan=False)


def test_the_command_adds_its_rows_and_tells_how_costs_grow(here: None, tmp_path: Path) -> None:
    settings = bench_scaling.ScalingBench(frames=(1, 2), width=96, iterations=2, output=tmp_path / "runs.jsonl")
    told = bench_scaling.run(settings)
    assert len(told.splitlines()) == 2 * 2 + 1
    assert "grows as frames^" in told
    rows = [json.loads(line) for line in (tmp_path / "runs.jsonl").read_text().splitlines()]
    assert {row["command"] for row in rows} == {
        "d2 bench scaling --frames 1 2 --width 96 --iterations 2 --output runs.jsonl"
    }


def test_growth_is_the_exponent_of_the_number_of_frames() -> None:
    def row(frames: int, seconds: float) -> Row:
        return make_row("scaling", "x", "priors", error=None, seconds=seconds, frames=frames, peak_mb=100.0)

    rows = [row(frames, 0.1 * frames**1.5) for frames in (5, 20, 80)]
    assert bench_scaling.growth(rows, "priors", "seconds") == pytest.approx(1.5)
    assert bench_scaling.growth(rows, "priors", "peak_mb") == pytest.approx(0, abs=1e-12)
    assert bench_scaling.growth(rows[:1], "priors", "seconds") is None


def fill(megabytes: int) -> float:
    return float(np.ones(megabytes * 125_000).sum())


@LINUX
def test_memory_is_that_of_the_work_not_of_what_was_there_before() -> None:
    before = np.ones(20_000_000)  # 160 MB that stay
    result, peak = in_fresh_process(fill, 100)
    assert result == 100 * 125_000
    assert 95 < peak < 130
    assert memory.peak_resident(lambda: fill(50)).peak_mb < 80
    assert before[0] == 1


@pytest.mark.slow
@LINUX
def test_the_whole_verification_in_processes_of_its_own(room: Path, tmp_path: Path) -> None:
    output = tmp_path / "runs.jsonl"
    settings = PlanVerification(
        str(room), ("train0", "train1"), (0, 1, 2), iterations=20, prior_frames=2, seeds=(5,), output=output
    )
    assert "one seed: no verdict" in plan_verify.run(settings)
    rows = [json.loads(line) for line in output.read_text().splitlines()]
    assert len(rows) == 7
    assert all(row["peak_mb"] > 0 for row in rows if not row["failed"])

"""`d2 bench training`: equal CPU time, rows as they finish, reruns of what lacks; workers end with their parent."""

import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from at_once import measured_at_once
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from d2_plugin.durable import CannotWrite
from d2_plugin.errors import D2Error
from d2_plugin.runs.ablation.presets import PRESETS
from d2_plugin.runs.rows import TRY, Row, make_row
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.shared import Shared
from d2_plugin.runs.training import bench as timed
from d2_plugin.runs.training.measured import Work, fingerprint, follow, measure, written

SETTINGS = RunSettings("room", ("a", "b"))


class TestBudget:
    @given(law=st.floats(0.9, 1.6), cost=st.floats(1e-3, 1e-1), target=st.floats(5, 200))
    def test_a_power_law_is_met_within_three_tries(self, law: float, cost: float, target: float) -> None:
        tried: list[tuple[int, float]] = []
        for _ in range(4):
            steps = timed.next_steps(target, tried)
            tried.append((steps, cost * steps**law))
            if timed.fits(target, tried[-1]):
                break
        steps = timed.nearest(target, tried)
        rounding = 1.5 / steps  # few steps cannot meet a time exactly
        assert abs(cost * steps**law / target - 1) <= timed.TOLERANCE + law * rounding

    def test_noise_between_two_near_lengths_does_not_turn_the_law_around(self) -> None:
        assert 100 < timed.next_steps(20, [(100, 10.0), (101, 9.0)]) < 300


class TestCases:
    def test_cameras_stand_behind_the_path(self) -> None:
        case = timed.case_of("data/studio@00+02@01+03", replace(SETTINGS, downscale=2))
        assert case.name == "studio, 2 views, 1/2 size"
        assert case.settings.train_cameras == ("00", "02")
        assert case.settings.test_cameras == ("01", "03")
        assert timed.case_of("studio@00", SETTINGS).settings.test_cameras is None

    @pytest.mark.parametrize("text", ["studio", "@00", "a@b@c@d", "", "studio@", "studio@+"])
    def test_a_recording_without_cameras_is_refused_with_an_example(self, text: str) -> None:
        refuses("PATH@00", timed.case_of, text, SETTINGS)


def now(work: Work) -> Future[Row]:
    """A row as if each step of the run had taken a twentieth of a second."""
    settings, future = work.settings, Future()
    about = {"fingerprint": fingerprint(work), "cameras": list(settings.train_cameras), "target": work.target}
    about |= {"seconds": settings.iterations / 20, "iterations": settings.iterations, "seed": settings.seed}
    future.set_result(make_row("quality", work.case, work.method, error=0.1, **about))
    return future


def bench(known: Sequence[Row], methods: Sequence[str] = ("backbone", "full"), **more: Any) -> list[Row]:
    """The rows that one call writes, given what lies there already."""
    settings = timed.TrainingBench(("room@a+b",), **more)
    case, shared = timed.Case("room, 2 views", "room", SETTINGS), Shared(Path("/out/room"), "dual")
    lines = [timed.line_of(timed.Method(settings, case, shared, PRESETS[name], "d2"), known) for name in methods]
    rows: list[Row] = []
    follow(lines, now, rows.append)
    return rows


class TestPlan:
    def test_a_budget_is_tried_with_one_seed_and_run_with_all(self) -> None:
        rows = [row for row in bench([], seconds=(10, 30)) if row["method"] == "yang4d full"]
        for budget in (10, 30):
            mine = [row for row in rows if row["target"] == f"{budget} s"]
            assert sorted(row["seed"] for row in mine) == [0, 1, 2]
            assert len({row["iterations"] for row in mine}) == 1
            assert mine[0]["seconds"] == pytest.approx(budget, rel=timed.TOLERANCE)
        assert {row["seed"] for row in rows if row["target"] == TRY} == {0}

    def test_a_rerun_does_nothing_and_a_wider_one_only_what_is_missing(self) -> None:
        first = bench([], seconds=(10,), seeds=(0, 1))
        assert bench(first, seconds=(10,), seeds=(0, 1)) == []
        more = bench(first, seconds=(10,), seeds=(0, 1, 2))
        assert [(row["method"], row["seed"]) for row in more] == [("yang4d backbone", 2), ("yang4d full", 2)]
        assert len(bench(first[:-1], seconds=(10,), seeds=(0, 1))) == 1

    def test_a_seed_that_is_named_twice_is_measured_once(self) -> None:
        rows = bench([], methods=("backbone",), steps=(20,), seeds=(0, 0, 1))
        assert [row["seed"] for row in rows] == [0, 1]

    def test_the_same_settings_under_a_label_are_measured_as_well(self) -> None:
        first = bench([], seconds=(10,), seeds=(0,))
        labelled = bench(first, seconds=(10,), seeds=(0,), label="mine")
        assert [row["method"] for row in labelled] == [f"{row['method']}, mine" for row in first]

    def test_steps_need_no_try_and_seconds_are_the_default(self) -> None:
        rows = bench([], steps=(70, 20), seeds=(5,))
        assert [row["iterations"] for row in rows if row["method"] == "yang4d backbone"] == [20, 70]
        assert {row["target"] for row in bench([])} == {TRY, "10 s", "30 s", "100 s"}

    def test_other_settings_are_other_runs_wherever_the_files_lie(self) -> None:
        def job(settings: RunSettings, **guidance: object) -> str:
            rival: Any = SimpleNamespace(identity=lambda: guidance) if guidance else None
            return fingerprint(Work(settings, Path("x"), Path("p"), "room", "full", "d2", TRY, guidance=rival))

        elsewhere = replace(SETTINGS, recording="/elsewhere/room", priors="/elsewhere/dual")
        assert job(elsewhere) == job(replace(SETTINGS, recording="room", priors="dual"))
        others = [replace(SETTINGS, seed=1), replace(SETTINGS, iterations=5), replace(SETTINGS, downscale=2)]
        assert len({job(SETTINGS), *map(job, others), job(SETTINGS, name="a"), job(SETTINGS, name="a", weight=2)}) == 6


def test_a_full_disk_is_no_result() -> None:
    with measured_at_once():
        refuses("full", measure, Mock(run=Mock(side_effect=CannotWrite("full"))))


def test_a_folder_of_another_run_is_no_result() -> None:
    with measured_at_once():
        refuses("holds another run", measure, Mock(run=Mock(side_effect=D2Error("it holds another run"))))


def test_a_run_without_a_score_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with written(tmp_path / "rows.jsonl", "bench", 1) as write:
        why = {"error": None, "seconds": None, "failed": "no camera was held out", "target": "5 steps"}
        write(make_row("quality", "room", "full", "5 steps", **why))
    assert "no score of room, full, 5 steps: no camera was held out" in caplog.text


PARENT = """
import os, time
from d2_plugin.runs.workers import worker_pool

if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 60).result()
"""


def runs(process: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc")
def test_a_busy_worker_ends_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        assert runs(worker)
        parent.kill()
        parent.wait()
    end = time.monotonic() + 10
    while runs(worker) and time.monotonic() < end:
        time.sleep(0.1)
    assert not runs(worker)

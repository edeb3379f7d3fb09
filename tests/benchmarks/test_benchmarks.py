"""The parts of `python -m benchmarks`: settings, where rows go, peers that solve what they claim, and the page."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import memory, scaling
from benchmarks.__main__ import PARTS, main
from benchmarks.align_measure import TRUE_LINE, AlignMethod, align_problem, methods
from benchmarks.gpu import proof as gpu
from benchmarks.memory import in_fresh_process
from benchmarks.report import EVERY
from benchmarks.stability.gaussians import difference, random_rotation, random_scene, render, turned
from benchmarks.stability.sweep import run_sweeps
from benchmarks.work_precision import means, pareto_front, work_precision
from d2_plugin.commands.cli import main as d2
from d2_plugin.runs.report.report import BUILDERS, make_report
from d2_plugin.runs.rows import Row, make_row, read_rows

CHECKOUT = Path(__file__).resolve().parents[2]
RUNS = Path(__file__).parents[1] / "data" / "runs.jsonl"
LINUX = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory is measured on Linux")


def test_parts_are_found_from_any_folder_and_a_mistake_is_one_sentence(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if Path(place).resolve() != CHECKOUT])
    for name in [name for name in sys.modules if name.partition(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, name)
    assert d2(["bench", "sterio"]) == 2
    said = capsys.readouterr().err
    assert "did you mean 'stereo'?" in said
    assert len(said.splitlines()) == 1
    assert main(["raster", "--sizes", "1"]) == 2
    assert "WIDTHxHEIGHT" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "rows", "shown"),
    [
        ("align --anchors 60,300 --outliers 0,0.4 --seeds 1 --seconds 0 --methods certified,RANSAC", 64, "gap 1e-10"),
        ("raster --scenes synth:30,synth:60 --sizes 24x16 --seconds 0 --no-memory", 4, "| d2 | synth:60 | 24x16 |"),
        ("stereo --rigs synthetic2 --width 96 --defaults-only", 1, "| synthetic2 | 2 | 96x54 |"),
        ("scaling --frames 1,2 --width 96 --iterations 2", 4, "frames^"),
        ("stability --sweeps epsilon", 16, "| epsilon | float32 | smoothing over median depth: 1e-08 .. 0.1 | 8 | 8 |"),
    ],
)
def test_a_part_adds_rows_of_what_it_measured_and_prints_their_tables(
    words, rows, shown, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("torch.set_num_threads", lambda count: None)
    monkeypatch.setattr(scaling, "in_fresh_process", lambda work, *given: memory.Measured(work(*given), 1.0))
    assert main([*words.split(), "--output", str(tmp_path / "rows.jsonl")]) == 0
    assert shown in capsys.readouterr().out
    found = read_rows([tmp_path / "rows.jsonl"])
    assert len(found) == rows
    begins = f"python -m benchmarks {words.split()[0]}"
    assert all(row["failed"] is None and row["command"].startswith(begins) for row in found)


@pytest.mark.parametrize("kind", EVERY)
def test_each_kind_becomes_a_section_also_where_nothing_has_a_result(kind: str, tmp_path: Path) -> None:
    rows = [row for row in read_rows([RUNS]) if row["kind"] == kind]
    assert rows, "the committed rows hold every kind"
    lost = [row | {"error": None, "failed": "refused", "verdict": "failure", "scores": {}} for row in rows[:2]]
    lost = [row | {"depth_error": None, "peak_mb": None} for row in lost]
    for name, some in (("whole", rows), ("lost", lost)):
        page, text, *plots = make_report(some, tmp_path / name, builders=EVERY)
        assert f'<section id="{kind}">' in page.read_text()
        assert all(f"]({plot.name})" in text.read_text() for plot in plots)
        assert name == "whole" or kind not in BUILDERS or "refused" in text.read_text()


@pytest.mark.parametrize("name", ["raster", "stereo-cuda", "profile"])
def test_a_step_of_the_proof_on_a_gpu_calls_a_part_with_words_that_the_part_takes(name: str) -> None:
    called = gpu.STEPS[name].words(gpu.GpuBench())
    part, *given = called[called.index("benchmarks") + 1 :]
    PARTS[part].form(part).parse(given)


def measured(method: str, setting: str, error: float | None, seconds: float | None, failed: str | None = None) -> Row:
    return make_row("stereo", "rig", method, setting, error=error, seconds=seconds, failed=failed)


@given(st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1e9)), max_size=30))
def test_every_point_off_the_front_is_beaten_by_one_on_it_and_none_of_the_front_is(points: list) -> None:
    front = [points[i] for i in pareto_front(points)]
    assert all(any(x <= p[0] and y <= p[1] for x, y in front) for p in points)
    assert not any(a != b and a[0] <= b[0] and a[1] <= b[1] for a in front for b in front)


def test_means_over_cases_are_geometric_and_failures_keep_a_setting_off_the_front() -> None:
    rows = [measured("a", "x", 0.01, 1.0), measured("a", "x", 0.04, 4.0), measured("b", "y", 0.5, 9.0)]
    rows += [measured("c", "z", 1e-9, 1e-9), measured("c", "z", None, None, "gave up")]
    first, _, third = means(rows)
    assert (first.error, first.seconds) == pytest.approx((0.02, 2.0))
    assert (third.cases, third.failures) == (2, 1)
    plot = work_precision(rows, "title", "error", "seconds")
    assert {series.name: series.points[0].faded for series in plot.series} == {"a": False, "b": True, "c": True}


@LINUX
def test_memory_is_that_of_the_work_not_of_what_was_there_before() -> None:
    before = np.ones(20_000_000)  # 160 MB that stay
    result, peak = in_fresh_process(eval, "len(b'x' * 100_000_000)")
    assert result == 100_000_000
    assert 95 < peak < 130
    assert before[0] == 1


@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("method", methods(), ids=lambda method: f"{method.name}, {method.setting}")
def test_every_method_finds_the_line_when_nothing_is_wrong(method: AlignMethod, kind: str) -> None:
    noisy = align_problem(kind, 2000, 0.0)
    problem = replace(noisy, mono=noisy.clean_mono, geometric=noisy.truth)
    line = method.fit(problem)
    np.testing.assert_allclose(line, TRUE_LINE, rtol=2e-3, atol=2e-4)
    assert problem.depth_error(line).max() < 5e-3


FLOAT32_ENDS = {"world offset": 100.0}
"""Beyond this float32 cannot hold the scene, which the report shows as a gap."""


def test_nothing_fails_and_only_what_float32_cannot_hold_is_a_gap() -> None:
    rows = run_sweeps()
    assert [row for row in rows if row["verdict"] == "failure"] == []
    for row in (row for row in rows if row["verdict"] == "gap"):
        assert row["method"] == "float32"
        assert row["value"] > FLOAT32_ENDS[row["case"]]


def test_a_scene_that_is_another_one_is_seen_to_differ() -> None:
    scene = random_scene()
    image = render(scene, torch.float64)
    assert difference(render(turned(scene, random_rotation(3)), torch.float64), image) < 1e-12
    assert difference(render(scene._replace(means=scene.means + 1e-3), torch.float64), image) > 1e-4

"""The parts of `python -m benchmarks`: settings, where rows go, peers that solve what they claim, and the page."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import showing

from benchmarks import memory, scaling
from benchmarks.__main__ import PARTS, main
from benchmarks.align_measure import TRUE_LINE, AlignMethod, align_problem, methods
from benchmarks.gpu import proof as gpu
from benchmarks.never_worse.maps import SPOILED, Spoiled, spoiled_recording
from benchmarks.priors import NORMAL_SHARE, PriorsBench, reliability_curve
from benchmarks.priors import run as run_priors
from benchmarks.priors_section import priors
from benchmarks.report import EVERY
from benchmarks.stability.sweep import run_sweeps
from benchmarks.stereo_measure import score
from benchmarks.work_precision import means, work_precision
from d2_plugin.commands.cli import main as d2
from d2_plugin.priors.declared_error import frames_with_truth
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.report.report import BUILDERS, make_report
from d2_plugin.runs.rows import Row, make_row, read_rows

CHECKOUT = Path(__file__).resolve().parents[2]
RUNS = Path(__file__).parents[1] / "data" / "runs.jsonl"


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
def test_a_part_adds_rows_and_prints_their_tables(words, rows, shown, tmp_path, capsys, monkeypatch) -> None:
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


def test_means_over_cases_are_geometric_and_failures_keep_a_setting_off_the_front() -> None:
    rows = [measured("a", "x", 0.01, 1.0), measured("a", "x", 0.04, 4.0), measured("b", "y", 0.5, 9.0)]
    rows += [measured("c", "z", 1e-9, 1e-9), measured("c", "z", None, None, "gave up")]
    first, _, third = means(rows)
    assert (first.error, first.seconds) == pytest.approx((0.02, 2.0))
    assert (third.cases, third.failures) == (2, 1)
    plot = work_precision(rows, "title", "error", "seconds")
    assert {series.name: series.points[0].faded for series in plot.series} == {"a": False, "b": True, "c": True}


@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("method", methods(), ids=lambda method: f"{method.name}, {method.setting}")
def test_every_method_finds_the_line_when_nothing_is_wrong(method: AlignMethod, kind: str) -> None:
    noisy = align_problem(kind, 2000, 0.0)
    problem = replace(noisy, mono=noisy.clean_mono, geometric=noisy.truth)
    line = method.fit(problem)
    np.testing.assert_allclose(line, TRUE_LINE, rtol=2e-3, atol=2e-4)
    assert problem.depth_error(line).max() < 5e-3


def test_nothing_fails_and_only_what_float32_cannot_hold_is_a_gap() -> None:
    rows = run_sweeps()
    assert [row for row in rows if row["verdict"] == "failure"] == []
    gaps = [row for row in rows if row["verdict"] == "gap"]
    assert {(row["method"], row["case"]) for row in gaps} == {("float32", "world offset")}, "another scene is seen"
    assert min(row["value"] for row in gaps) > 100, "from there on float32 cannot hold the scene"


def test_scores_count_what_they_say() -> None:
    truth = np.full((1, 10), 2.0, np.float32)
    truth[0, 9] = 0  # unknown
    depth = np.array([[2, 2, 2.01, 2.05, 2.5, 0, 0, 0, 2, 3]], np.float32)
    seen = np.array([[1, 1, 1, 1, 1, 1, 1, 1, 0, 0]], bool)
    found = score([depth, depth], [truth, None], [seen, np.zeros_like(seen)])
    assert found.completeness == pytest.approx(5 / 8)
    assert found.within == pytest.approx(4 / 6)
    assert found.wrong == pytest.approx(1 / 6)
    assert found.median == pytest.approx(0.0025, rel=1e-3)
    assert found.f1 == pytest.approx(2 * (4 / 6) * (3 / 8) / (4 / 6 + 3 / 8))
    assert found.pixels == 8


@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_the_curve_of_known_errors_lies_as_many_times_above_the_diagonal_as_they_are_too_large(times: float) -> None:
    rng = np.random.default_rng(0)
    sigma = 10 ** rng.uniform(-3, -1, 200_000)
    curve = reliability_curve(np.abs(times * sigma * rng.standard_normal(sigma.size)), sigma)
    assert len(curve) == 8, "two decades at four bins"
    for point in curve:
        assert point.error == pytest.approx(times * point.sigma, rel=0.05)
    assert [point.sigma for point in curve] == sorted(point.sigma for point in curve)
    assert sum(point.pixels for point in curve) == sigma.size


def test_bins_of_a_few_pixels_and_a_sigma_of_zero_have_no_mark() -> None:
    few, rare = np.full(29, 0.02), np.concatenate([np.full(10_000, 0.02), np.full(50, 0.5)])
    assert reliability_curve(few, few) == ()
    assert [point.pixels for point in reliability_curve(rare, rare)] == [10_000]
    assert reliability_curve(np.zeros(100), np.zeros(100)) == ()
    assert reliability_curve(np.zeros(0), np.zeros(0)) == ()


def test_a_rendered_rig_is_measured_without_any_data_and_drawn(tmp_path: Path) -> None:
    output = tmp_path / "rows.jsonl"
    told = run_priors(PriorsBench(rigs=("synthetic4",), width=96, frames=(0,), output=output))
    rows = read_rows([output])
    assert "synthetic4, 4 views" in told
    assert "held against the true depth of 4 views" in told
    assert {row["kind"] for row in rows} == {"priors"}
    *labels, far, motion = rows
    assert [row["method"] for row in rows] == ["verified", "agreed", "mono only", "far", "motion"]
    for row in labels:
        assert row["error"] == pytest.approx(abs(row["within"] - NORMAL_SHARE))
        assert 0 < row["share"] < 1
        assert row["seconds"] > 0
        assert row["mono_emulated"]
        assert all(len(point) == 3 for point in row["curve"])
    assert far["error"] == far["false_far"]
    assert 0.2 < motion["motion_right"] < motion["motion_known"] < 1
    assert motion["motion_psnr"] > 15
    assert 0 < motion["motion_within"] < motion["motion_within_two"] < 1
    line = "python -m benchmarks priors --rigs synthetic4 --frames 0 --width 96 --output rows.jsonl"
    assert rows[0]["command"] == line, "no folder of this machine"
    make_report(rows, tmp_path, builders={"priors": priors})
    svg, text = (tmp_path / "priors.svg").read_text(), (tmp_path / "report.md").read_text()
    assert svg.count(" pixels</title>") == sum(len(row["curve"]) for row in labels) > 0
    assert "| synthetic4, 4 views | mono only |" in text
    assert "emulated, not predicted" in text
    assert "What moves: scene flow, and what lies between two instants" in text


def test_frames_with_truth_are_those_of_any_of_the_cameras() -> None:
    whole = synthetic_recording(1, held_out=0, frames=10, width=16, height=9)
    recording = showing(whole, {"depth": lambda name, frame: None if frame == 9 else whole.depth(name, frame)})
    assert frames_with_truth(recording, ["train0"]) == list(range(9))
    assert frames_with_truth(recording, []) == []
    assert frames_with_truth(recording, ["train0"], most=3) == [0, 4, 8], "spread over the recording"
    assert frames_with_truth(recording, ["train0"], most=9) == list(range(9))


@pytest.mark.parametrize("kind", SPOILED)
def test_a_spoiled_recording_differs_in_its_maps_alone(saved_room: Callable, tmp_path: Path, kind: Spoiled) -> None:
    room = saved_room(cameras=2, held_out=1, frames=2, width=96, height=54, arc_degrees=15)
    before = open_recording(room)
    cameras = list(before.cameras)[:2]
    after = open_recording(spoiled_recording(room, cameras, None, kind, tmp_path, PriorSettings()))
    assert after.name == before.name
    assert after.mono_kind == before.mono_kind
    assert after.mono_emulated == before.mono_emulated
    for camera in cameras:
        for frame in before.frames:
            assert np.array_equal(after.image(camera, frame), before.image(camera, frame))
            assert np.array_equal(after.depth(camera, frame), before.depth(camera, frame))
            assert not np.array_equal(after.mono(camera, frame), before.mono(camera, frame))
    assert after.mono(list(before.cameras)[2], before.frames[0]) is None, "a camera that does not train needs no map"

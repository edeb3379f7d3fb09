"""`python -m benchmarks`: scores of stereo and priors are what they are called, maps are spoiled as said."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.never_worse.maps import SPOILED, Spoiled, spoiled_recording
from benchmarks.priors import PriorsBench, cases, run
from benchmarks.priors_section import DIAGONAL, priors
from benchmarks.stereo_measure import score
from d2_plugin.priors.declared_error import NORMAL_SHARE, frames_with_truth, reliability_curve
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.report.report import make_report
from d2_plugin.runs.rows import read_rows

pytest.importorskip("cv2")


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
    told = run(PriorsBench(rigs=("synthetic4",), width=96, frames=(0,), output=output))
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
    assert DIAGONAL in svg
    assert "true error, 68 % quantile" in svg
    assert "| synthetic4, 4 views | mono only |" in text
    assert "emulated, not predicted" in text
    assert "What moves: scene flow, and what lies between two instants" in text


def test_frames_with_truth_are_those_of_any_of_the_cameras(tmp_path: Path) -> None:
    folder = save_recording(synthetic_recording(2, held_out=0, frames=3, width=96, height=54), tmp_path / "den")
    for depth in folder.glob("depth/*/00001.*"):
        depth.unlink()
    recording = cases(PriorsBench((str(folder),)))[0].recording
    assert frames_with_truth(recording, ["train0"]) == [0, 2]
    assert frames_with_truth(recording, []) == []
    long = synthetic_recording(1, held_out=0, frames=9, width=16, height=9)
    assert frames_with_truth(long, ["train0"], most=3) == [0, 4, 8], "spread over the recording"
    assert frames_with_truth(long, ["train0"], most=9) == list(range(9))


@pytest.fixture(scope="module")
def room(saved_room: Callable[..., Path]) -> Path:
    return saved_room(cameras=2, held_out=1, frames=2, width=96, height=54, arc_degrees=15)


@pytest.mark.parametrize("kind", SPOILED)
def test_a_spoiled_recording_differs_in_its_maps_alone(room: Path, tmp_path: Path, kind: Spoiled) -> None:
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

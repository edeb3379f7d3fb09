"""`d2 bench stereo`: scores are what they are called, the outsider is set up rightly, and results are written."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sgbm import sgbm
from benchmarks.stereo import StereoBench, bench_stereo, run, table
from benchmarks.stereo_measure import Method, measure, methods, score
from benchmarks.stereo_rigs import Rig, load_rigs, textured_rig
from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filtering.filter import filter_depths
from d2_plugin.priors.stereo.geometric_depth import gray

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return textured_rig(2, width=192, height=108)


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


def test_no_depth_at_all_scores_nothing_and_has_no_error() -> None:
    found = score([np.zeros((3, 4))], [np.ones((3, 4))], [np.ones((3, 4), bool)])
    assert found.completeness == found.f1 == 0
    assert np.isnan(found.median)


def test_the_truth_itself_scores_full_marks_where_views_overlap(rig: Rig) -> None:
    found = score(rig.truths, rig.truths, rig.covisible)
    assert found.completeness == found.f1 == 1
    assert 0.6 < np.mean(rig.covisible) < 0.95


def test_covisibility_without_the_other_truth_is_nearly_that_with_it(rig: Rig) -> None:
    alone = replace(rig, truths=[rig.truths[0], None])
    assert (alone.covisible[0] == rig.covisible[0]).mean() > 0.97
    assert not alone.covisible[1].any()


def test_the_outsider_is_right_about_most_of_what_the_filter_leaves_it(rig: Rig) -> None:
    grays, settings = [gray(image) for image in rig.images], StereoSettings()
    maps = sgbm(grays, rig.cameras, rig.depth_range, settings)
    results = filter_depths(grays, rig.cameras, *map(list, zip(*maps)), settings)
    found = score([result.depth for result in results], rig.truths, rig.covisible)
    assert found.completeness > 0.15
    assert found.wrong < 0.02


def test_a_method_that_fails_on_a_rig_says_why_and_counts_as_nothing(rig: Rig) -> None:
    def refuses(*_: object) -> list:
        raise D2Error("disparities span more than the image")

    broken = Method("broken", "default", refuses, StereoSettings())
    row = measure(broken, [rig])
    assert row["failed"] == "disparities span more than the image"
    working = {**measure(methods()[-1], [rig]), "method": "broken"}
    circumstances = {"device": "cpu", "threads": 1, "torch": "2", "commit": "abc", "version": "1", "command": "x"}
    lines = table([{**row, **circumstances}, {**working, **circumstances}]).splitlines()
    assert any(line.startswith("| synthetic2 | 2 | 192x108 | broken | default | failed |") for line in lines)
    mean = next(line for line in lines if line.startswith("| broken | default |"))
    assert mean.split("|")[3].strip() == f"{working['completeness'] / 2:.3f}"


def test_bench_writes_rows_table_and_plot(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.stereo._set_threads", lambda count: None)
    settings = StereoBench(
        rigs=("synthetic2",), width=96, makers=("patchmatch", "sgbm"), defaults_only=True, output=tmp_path
    )
    told = run(settings)
    assert "| patchmatch | default |" in told, "what a command made is printed"
    assert told.endswith(f"are in {tmp_path}")
    rows = [json.loads(line) for line in (tmp_path / "stereo.jsonl").read_text().splitlines()]
    assert [(row["method"], row["rig"], row["width"]) for row in rows] == [
        ("patchmatch", "synthetic2", 96),
        ("sgbm", "synthetic2", 96),
    ]
    assert all(row["kind"] == "stereo" and row["error"] == 1 - row["f1"] for row in rows)
    assert all(row["cpu"] > 0 and row["command"].startswith("d2 bench stereo --rigs") for row in rows)
    assert "| synthetic2 | 2 | 96x54 | patchmatch | default |" in (tmp_path / "stereo.md").read_text()
    assert (tmp_path / "stereo.svg").stat().st_size > 1000


def test_an_unknown_rig_or_maker_is_told(tmp_path) -> None:
    with pytest.raises(D2Error, match="unknown rig 'studi'.*did you mean 'studio'"):
        load_rigs("studi", None)
    with pytest.raises(D2Error, match="unknown stereo matcher 'patchmach'.*did you mean 'patchmatch'"):
        bench_stereo(tmp_path, rigs=["synthetic2"], makers=["patchmach"])
    with pytest.raises(D2Error, match="no such recording"):
        load_rigs("studio", tmp_path)

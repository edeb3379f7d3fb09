"""`d2 bench stereo`: scores are what they are called, and results are written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stereo import tables
from benchmarks.stereo_measure import Method, measure, methods, score
from benchmarks.stereo_rigs import Rig, textured_rig
from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import StereoSettings

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


def test_the_truth_itself_scores_full_marks_where_views_overlap(rig: Rig) -> None:
    found = score(rig.truths, rig.truths, rig.covisible)
    assert found.completeness == found.f1 == 1
    assert 0.6 < np.mean(rig.covisible) < 0.95


def test_covisibility_without_the_other_truth_is_nearly_that_with_it(rig: Rig) -> None:
    alone = replace(rig, truths=[rig.truths[0], None])
    assert (alone.covisible[0] == rig.covisible[0]).mean() > 0.97
    assert not alone.covisible[1].any()


def test_a_method_that_fails_on_a_rig_says_why_and_counts_as_nothing(rig: Rig) -> None:
    def refuses(*_: object) -> list:
        raise D2Error("disparities span more than the image")

    broken = Method("broken", "default", refuses, StereoSettings())
    row = measure(broken, [rig])
    assert row["failed"] == "disparities span more than the image"
    working = {**measure(methods()[-1], [rig]), "method": "broken", "setting": "default"}
    (_, means), (_, every) = tables([row, working])
    assert every.rows[0][:6] == ("synthetic2", "2", "192x108", "broken", "default", "failed")
    assert means.rows[0][:3] == ("broken", "default", f"{working['completeness'] / 2:.3f}")

"""`python -m benchmarks`: peers of the fit solve what they claim, scenes are what they are called."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.align_measure import TRUE_LINE, AlignMethod, align_problem, methods, optimum
from benchmarks.stability.gaussians import difference, random_rotation, random_scene, render, turned
from benchmarks.stability.sweep import run_sweeps


@pytest.mark.parametrize("kind", ["relative", "metric"])
@pytest.mark.parametrize("method", methods(), ids=lambda method: f"{method.name}, {method.setting}")
def test_every_method_finds_the_line_when_nothing_is_wrong(method: AlignMethod, kind: str) -> None:
    noisy = align_problem(kind, 2000, 0.0)
    problem = replace(noisy, mono=noisy.clean_mono, geometric=noisy.truth)
    line = method.fit(problem)
    np.testing.assert_allclose(line, TRUE_LINE, rtol=2e-3, atol=2e-4)
    assert problem.depth_error(line).max() < 5e-3


def test_no_line_beats_the_optimum_that_gaps_are_measured_from() -> None:
    problem = align_problem("relative", 1000, 0.3)
    rng = np.random.default_rng(0)
    for residual in ("relative", "absolute"):
        best = optimum(problem, residual)
        for method in methods():
            assert problem.objective(method.fit(problem), residual) >= best * (1 - 1e-12)
        for _ in range(200):
            line = np.array(TRUE_LINE) * (1 + rng.normal(0, 0.05, 2))
            assert problem.objective(tuple(line), residual) >= best


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

"""`d2 bench align`: the peers solve what they claim to solve, errors are what they are called, results are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.align import AlignBench, run, tables
from benchmarks.align_measure import (
    TRUE_LINE,
    AlignMethod,
    align_problem,
    methods,
    optimum,
)
from d2_plugin.runs.rows import read_rows


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


def test_a_refusal_is_counted_and_no_error_is_made_up_for_it(tmp_path: Path) -> None:
    run(AlignBench((20, 300), (0.0,), ("align()",), 1, 0.0, output=tmp_path / "rows.jsonl"))
    rows = read_rows([tmp_path / "rows.jsonl"])
    refused = [row for row in rows if row["failed"]]
    assert {row["anchors"] for row in refused} == {20}
    assert all("too few pixels" in row["failed"] and row["error"] is None for row in refused)
    assert "(1 of 2 refused)" in str(tables(rows))

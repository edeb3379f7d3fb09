"""`d2 stability`: what holds over the whole range of each parameter, and that a sweep can fail."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from benchmarks.stability.gaussians import difference, largest, random_rotation, random_scene
from benchmarks.stability.sweep import SWEEPS, measure, run_sweeps, tables
from d2_plugin.errors import D2Error
from d2_plugin.runs.rows import Row

FLOAT32_ENDS = {"world offset": 100.0}
"""Beyond this float32 cannot hold the scene, which the report shows as a gap."""


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return run_sweeps()


def test_nothing_fails_and_only_what_float32_cannot_hold_is_a_gap(rows: list[Row]) -> None:
    assert [row for row in rows if row["verdict"] == "failure"] == []
    for row in (row for row in rows if row["verdict"] == "gap"):
        assert row["method"] == "float32"
        assert row["value"] > FLOAT32_ENDS[row["case"]]


def test_what_float32_cannot_hold_is_told_rather_than_clamped(rows: list[Row]) -> None:
    far = [row for row in rows if (row["case"], row["method"], row["value"]) == ("world offset", "float32", 1e6)]
    assert [row["verdict"] for row in far] == ["gap"]
    assert any(row[:4] == ("world offset", "float32", "1e+06", "gap") for row in tables(rows)[2][1].rows)


def test_a_point_that_is_refused_or_not_finite_is_a_failure_and_one_above_its_limit_a_gap() -> None:
    def refuses(value: float, dtype: torch.dtype) -> float:
        raise D2Error("no such thing")

    sweep = SWEEPS["depth"]
    assert measure(replace(sweep, measure=refuses), 1.0, "float64")["failed"] == "refused: no such thing"
    for error, verdict in ((math.nan, "failure"), (math.inf, "failure"), (1.0, "gap"), (0.0, "ok")):
        row = measure(replace(sweep, measure=lambda value, dtype, e=error: e), 1.0, "float64")
        assert row["verdict"] == verdict
        assert json.dumps(row, allow_nan=False)


def test_a_nan_anywhere_is_not_lost_among_smaller_errors() -> None:
    scene = random_scene()
    image = scene.render(torch.float64)
    for part in image._fields[:3]:
        broken = image._replace(**{part: getattr(image, part) * torch.full((), math.nan, dtype=torch.float64)})
        assert math.isnan(difference(broken, image))
    assert math.isnan(largest(0.1, math.nan))
    assert math.isnan(largest(math.nan, 0.1))


def test_a_scene_that_is_another_one_is_seen_to_differ() -> None:
    scene = random_scene()
    image = scene.render(torch.float64)
    assert difference(scene.turned(random_rotation(3)).render(torch.float64), image) < 1e-12
    assert difference(scene._replace(means=scene.means + 1e-3).render(torch.float64), image) > 1e-4

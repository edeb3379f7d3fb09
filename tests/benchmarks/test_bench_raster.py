"""`d2 bench raster` measures what it says, on scenes that are what they are called."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from benchmarks.growth import exponent
from benchmarks.raster import RasterBench, bench_raster, parse_size, run
from benchmarks.raster_measure import THRESHOLDS, Case, peak_memory, threshold_errors
from benchmarks.raster_scenes import load_scene
from d2_plugin.errors import D2Error
from d2_plugin.rasterizer import RasterSettings, reference


def test_synthetic_gaussians_have_the_radius_and_the_frustum_they_are_described_with():
    scene = load_scene("synth:4000", 640, 360).to(torch.float64)
    screen = reference.project(scene.splats(), scene.view, RasterSettings())
    x, y, slope = screen.variance_x, screen.variance_y, screen.slope
    middle, covariance = (x + y) / 2, slope * y
    major = middle + (middle.square() - (x * y - covariance.square())).clamp(min=0).sqrt()
    assert (3 * major.sqrt()).mean().item() == pytest.approx(4.0, rel=0.02)
    inside = ((screen.centers >= 0) & (screen.centers <= torch.tensor([640, 360]))).all(1)
    assert inside.double().mean().item() == pytest.approx(1 / 1.1**2, abs=0.02)
    assert scene.means[:, 2].min() >= 2
    assert scene.means[:, 2].max() <= 20


def test_a_scene_is_the_same_at_every_size_and_every_time():
    small, large = load_scene("synth:100", 320, 180), load_scene("synth:100", 640, 360)
    for part, other in zip(small[:5], large[:5]):
        assert torch.equal(part, other)
    assert torch.equal(2 * small.view.K[:2], large.view.K[:2])


def test_the_garden_is_cropped_as_gsplat_does(shared_data):
    scene = load_scene("garden", 640, 360, shared_data("test_garden.npz"))
    assert len(scene.means) == 111_785
    assert scene.means.abs().max() <= 2
    assert reference.visible(scene.splats(), scene.colors, scene.view, RasterSettings()).numel() > 50_000


@pytest.mark.parametrize(
    ("name", "message"), [("synth", "synth:N"), ("synth:many", "synth:N"), ("garden", "test_garden.npz")]
)
def test_an_unknown_scene_is_told(name, message):
    with pytest.raises(D2Error, match=message):
        load_scene(name, 64, 48)


@pytest.mark.parametrize("text", ["640", "640x", "ax3", "0x5"])
def test_a_size_that_is_none_is_told(text):
    with pytest.raises(D2Error, match="not WIDTHxHEIGHT"):
        parse_size(text)


def test_scaling_exponent_is_the_slope_in_logarithms():
    assert exponent([(n, 3 * n**1.5) for n in (10, 100, 1000)]) == pytest.approx(1.5)
    assert exponent([(10, 1.0), (10, 2.0)]) is None


def test_bench_writes_rows_table_and_plot(tmp_path):
    told = run(
        RasterBench(scenes=("synth:30", "synth:60"), sizes=("24x16",), seconds=0, no_memory=True, output=tmp_path)
    )
    every = [json.loads(line) for line in (tmp_path / "raster.jsonl").read_text().splitlines()]
    rows = [row for row in every if "thresholds" not in row]
    assert [(row["method"], row["gaussians"]) for row in rows] == [
        *(("d2", 30), ("torch reference", 30)),
        *(("d2", 60), ("torch reference", 60)),
    ]
    for row in rows:
        assert row["kind"] == "raster"
        assert row["error"] == row["errors"]["color"]["p99.9"]
        assert row["passes"]["forward"]["repeats"] >= 3
        assert 0 < row["passes"]["forward+backward"]["min_ms"] <= row["passes"]["forward+backward"]["median_ms"]
        assert 0 < row["errors"]["color"]["max"] < 1e-3
        assert 0 < row["errors"]["grad covariances"]["relative_l2"] < 1e-3
        assert row["command"] == (
            "d2 bench raster --scenes synth:30 synth:60 --sizes 24x16 --seconds 0.0 --no-memory "
            f"--output {tmp_path.name}"
        )
        assert not math.isnan(row["passes"]["forward"]["cpu_ms"])
    table = (tmp_path / "raster.md").read_text()
    assert "| d2 | synth:60 | 24x16 |" in table
    assert "N^" in table
    assert table in told
    assert told.endswith(f"are in {tmp_path}")
    assert (tmp_path / "raster.svg").stat().st_size > 1000


def test_lower_thresholds_are_nearer_to_the_image_without_any(tmp_path):
    found = threshold_errors(load_scene("synth:400", 64, 36), torch.device("cpu"))
    assert list(found) == list(THRESHOLDS)
    by_alpha = [found[f"alpha {name}"] for name in ("1/64, T 1e-4", "1/255, T 1e-4 (default)", "1e-4, T 1e-5")]
    assert by_alpha == sorted(by_alpha, reverse=True)
    assert found["alpha 1e-5, T 1e-6"] < 1e-4 < found["alpha 1/64, T 1e-4"]


def test_beyond_the_limit_the_error_is_left_out_not_guessed(tmp_path):
    small = {"scenes": ["synth:20"], "sizes": ["16x16"], "seconds": 0}
    (row, _) = bench_raster(tmp_path, **small, error_limit=10, memory=False)
    assert row["error"] is None
    assert row["errors"] is None
    assert "| - | - | - | - | - |" in (tmp_path / "raster.md").read_text()


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory is measured on Linux")
def test_peak_memory_is_that_of_the_call_not_of_the_process():
    case = Case("synth:30000", 320, 180, None)
    peak = peak_memory(case, "d2", torch.device("cpu"))
    records = 30_000 * 64 / 1e6
    assert records < peak < 40 * records

"""`d2 bench raster` measures what it says, on scenes that are what they are called."""

from __future__ import annotations

import pytest
import torch

from benchmarks.raster import RasterBench, run
from benchmarks.raster_scenes import Scene, load_scene
from d2_plugin.rasterizer import RasterSettings, reference
from d2_plugin.runs.rows import read_rows


def test_synthetic_gaussians_have_the_radius_and_the_frustum_they_are_described_with():
    made = load_scene("synth:4000", 640, 360)
    scene = Scene(*(part.double() for part in made[:5]), made.view)
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


def test_bench_adds_rows_and_prints_their_tables(tmp_path):
    path = tmp_path / "rows.jsonl"
    told = run(RasterBench(("synth:30", "synth:60"), ("24x16",), seconds=0, no_memory=True, output=path))
    rows = read_rows([path])
    assert [(row["method"], row["gaussians"]) for row in rows] == [
        *(("d2", 30), ("torch reference", 30)),
        *(("d2", 60), ("torch reference", 60)),
    ]
    for row in rows:
        assert row["error"] == row["errors"]["color"]["p99.9"]
        assert row["passes"]["forward"]["repeats"] >= 3
        assert 0 < row["errors"]["color"]["max"] < 1e-3
        assert 0 < row["errors"]["grad covariances"]["relative_l2"] < 1e-3
    assert "| d2 | synth:60 | 24x16 |" in told

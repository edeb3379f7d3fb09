"""`d2 bench raster` measures what it says, on scenes that are what they are called."""

from __future__ import annotations

import pytest
import torch

from benchmarks.raster_scenes import load_scene
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


def test_the_garden_is_cropped_as_gsplat_does(shared_data):
    scene = load_scene("garden", 640, 360, shared_data("test_garden.npz"))
    assert len(scene.means) == 111_785
    assert scene.means.abs().max() <= 2
    assert reference.visible(scene.splats(), scene.colors, scene.view, RasterSettings()).numel() > 50_000

"""Geometric depth of one instant: how good it is, where the depth range comes from, and how matchers are chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stereo_rigs import textured_rig
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.depth_range import depth_bounds
from d2_plugin.priors.stereo.filtering.filter import GeometricDepth
from d2_plugin.priors.stereo.geometric_depth import enlarged, geometric_depth
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")

SETTINGS = StereoSettings(matcher="patchmatch")


@pytest.fixture(scope="module")
def pair() -> Recording:
    """Two views 10 degrees apart."""
    return synthetic_recording(cameras=2, held_out=0, frames=1, width=256, height=144, arc_degrees=10)


def run(recording: Recording, bounds: tuple[float, float], settings: StereoSettings = SETTINGS) -> list[GeometricDepth]:
    names = list(recording.cameras)
    images = [recording.image(name, 0) for name in names]
    return geometric_depth(images, list(recording.cameras.values()), bounds, settings)


def scores(results: list[GeometricDepth], recording: Recording) -> tuple[float, float, float]:
    """Completeness, median relative error and share of errors above 5 % over all views."""
    truths = [recording.depth(name, 0) for name in recording.cameras]
    errors = [np.abs(r.depth - t)[r.depth > 0] / t[r.depth > 0] for r, t in zip(results, truths)]
    together = np.concatenate(errors)
    completeness = float(np.mean([(r.depth > 0).mean() for r in results]))
    return completeness, float(np.median(together)), float((together > 0.05).mean())


def test_a_good_part_of_a_narrow_pair_is_matched(pair: Recording) -> None:
    completeness, median, wrong = scores(run(pair, (2.0, 9.0)), pair)
    assert completeness > 0.2
    assert median < 0.006
    assert wrong < 0.02


def test_half_resolution_comes_back_at_full_size(pair: Recording) -> None:
    results = run(pair, (2.0, 9.0), replace(SETTINGS, max_pixels=128 * 72))
    assert results[0].depth.shape == (144, 256)
    completeness, median, wrong = scores(results, pair)
    assert completeness > 0.05
    assert median < 0.012
    assert wrong < 0.03


def test_half_the_size_fills_what_the_full_size_leaves_empty(pair: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    both = run(pair, (2.0, 9.0))
    monkeypatch.setattr("d2_plugin.priors.stereo.geometric_depth.SCALES", (1,))
    full = run(pair, (2.0, 9.0))
    for camera, one, alone in zip(pair.cameras, both, full):
        known = alone.depth > 0
        np.testing.assert_array_equal(one.depth[known], alone.depth[known])
        filled = (one.depth > 0) & ~known
        assert filled.sum() > 0.02 * known.sum()
        assert one.record["survivors"]["filled"] == np.count_nonzero(one.depth)
        truth = pair.depth(camera, 0)
        assert truth is not None
        errors = np.abs(one.depth[filled] / truth[filled] - 1)
        assert np.median(errors) < 0.01
        assert (errors < 2 * one.sigma[filled]).mean() > 0.75
        assert np.median(one.sigma[filled]) > np.median(one.sigma[known])


def geometric(depth: np.ndarray) -> GeometricDepth:
    """One view's depth with a sigma of one per cent."""
    sigma = np.where(depth > 0, 0.01, np.inf).astype(np.float32)
    return GeometricDepth(depth, sigma, {})


def test_enlarging_a_plane_is_exact_and_an_edge_is_left_out() -> None:
    v, u = np.mgrid[:20, :30]
    inverse = 0.2 + 0.001 * u + 0.002 * v
    small = geometric((1 / inverse).astype(np.float32))
    large = enlarged(small, 60, 40, tolerance=0.05)
    v, u = (np.mgrid[:40, :60] + 0.5) / 2 - 0.5
    inside = np.s_[2:-2, 2:-2]  # the outermost pixels extrapolate, and take the value at the rim
    np.testing.assert_allclose(large.depth[inside], (1 / (0.2 + 0.001 * u + 0.002 * v))[inside], rtol=1e-5)
    step = np.where(np.arange(30) < 15, 2.0, 4.0)[None].repeat(20, 0).astype(np.float32)
    edge = enlarged(geometric(step), 60, 40)
    assert set(np.unique(edge.depth)) == {0, 2, 4}
    assert not edge.depth[:, 29:31].any()
    hole = step.copy()
    hole[10, 5] = 0
    assert not enlarged(geometric(hole), 60, 40).depth[20:22, 10:12].any()
    np.testing.assert_array_equal(np.isfinite(edge.sigma), edge.depth > 0)
    np.testing.assert_array_equal(edge.sigma[edge.depth > 0], np.float32(0.01))


def test_the_depth_range_comes_from_points_then_the_data_set_then_the_baselines(pair: Recording) -> None:
    cameras = list(pair.cameras.values())
    rng = np.random.default_rng(0)
    local = np.stack([rng.uniform(-0.3, 0.3, 500), rng.uniform(-0.2, 0.2, 500), np.linspace(3, 5, 500)], axis=1)
    pose = cameras[0].T_camera_world
    points = (local - pose[:3, 3]) @ pose[:3, :3]
    measured = depth_bounds(cameras, points)
    assert 3 * 0.7 < measured.near < 3 * 0.8
    assert 5 * 1.2 < measured.far < 5 * 1.4
    assert "triangulated" in measured.origin
    declared = depth_bounds([replace(camera, near_far=(2.0, 10.0)) for camera in cameras])
    assert declared[:2] == pytest.approx((1.6, 12.0))
    few = points[:60]  # on one thing, at 3 to 3.2
    wide = depth_bounds([replace(camera, near_far=None) for camera in cameras], few)
    truth = np.concatenate([pair.depth(name, 0).ravel() for name in pair.cameras])
    assert wide.near < truth.min()
    assert wide.far > truth.max()
    assert "cameras alone" in wide.origin


@pytest.mark.parametrize("views", [2, 4])
def test_the_range_from_triangulated_points_holds_what_two_views_see(views: int) -> None:
    pytest.importorskip("pycolmap")
    from d2_plugin.priors.colmap.points import triangulate

    rig = textured_rig(views)
    bounds = depth_bounds(rig.cameras, triangulate(rig.images, rig.cameras).positions)
    truth = np.concatenate([depth[seen] for depth, seen in zip(rig.truths, rig.covisible)])
    assert np.mean((truth < bounds.near) | (truth > bounds.far)) < 1e-3
    assert bounds.far / bounds.near < 4 * truth.max() / truth.min()


def test_cameras_that_look_at_each_other_across_a_room_have_a_range_that_holds_it() -> None:
    """At wide angles disparity says nothing about the near end, but the frusta do."""
    room = synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=120)
    cameras = [replace(camera, near_far=None) for camera in room.cameras.values()]
    bounds = depth_bounds(cameras)
    truth = np.concatenate([room.depth(name, 0).ravel() for name in room.cameras])
    assert 0.05 * truth.min() < bounds.near < truth.min()
    assert bounds.far > truth.max()


def test_points_behind_or_beside_the_camera_do_not_count(pair: Recording) -> None:
    cameras = list(pair.cameras.values())
    backwards = -5 * cameras[0].T_camera_world[2, :3]
    behind = cameras[0].centre + backwards + np.random.default_rng(0).normal(0, 0.1, (200, 3))
    assert "triangulated" not in depth_bounds(cameras, behind).origin

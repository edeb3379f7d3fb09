"""The final filter: true depth passes where it is seen twice, wrong depth does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filtering.confirm import confirm
from d2_plugin.priors.stereo.filtering.filter import filter_depths, remove_speckles, texture_mask
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")

SETTINGS = StereoSettings()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(cameras=3, frames=1, width=160, height=90, arc_degrees=30)


def views(recording: Recording) -> tuple[list, list, list, list]:
    """Grey images, cameras, true depths and perfect costs of the training views."""
    names = ["train0", "train1", "train2"]
    depths = [recording.depth(name, 0) for name in names]
    grays = [gray(recording.image(name, 0)) for name in names]
    return grays, [recording.cameras[name] for name in names], depths, [np.zeros_like(depth) for depth in depths]


def test_true_depth_survives_where_another_view_sees_it(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    results = filter_depths(grays, cameras, depths, costs, SETTINGS)
    for result, depth in zip(results, depths):
        assert result.valid.mean() > 0.5
        np.testing.assert_array_equal(result.depth[result.valid], depth[result.valid])
        assert list(result.survivors.values()) == sorted(result.survivors.values(), reverse=True)
        assert result.survivors["kept"] == result.valid.sum()


def test_depth_that_is_wrong_in_one_view_is_dropped_there(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    wrong = np.zeros(depths[1].shape, bool)
    wrong[20:60, 40:90] = True
    depths[1] = np.where(wrong, depths[1] * 1.15, depths[1]).astype(np.float32)
    result = filter_depths(grays, cameras, depths, costs, SETTINGS)[1]
    assert result.valid[wrong].mean() < 0.02
    assert result.valid[~wrong].mean() > 0.4


def test_random_depth_leaves_nearly_nothing(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    rng = np.random.default_rng(0)
    noise = [rng.uniform(2, 8, depth.shape).astype(np.float32) for depth in depths]
    for result in filter_depths(grays, cameras, noise, costs, SETTINGS):
        assert result.valid.mean() < 0.001


def test_bad_matches_are_dropped(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    costs[0] = np.full_like(costs[0], SETTINGS.cost_max + 0.01)
    results = filter_depths(grays, cameras, depths, costs, SETTINGS)
    assert not results[0].valid.any()
    # A depth that did not match is not there, so it cannot confirm another view either.
    assert results[1].confirmations.max() == 1


def test_nan_and_negative_depths_are_no_depths(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    depths[0] = depths[0].copy()
    depths[0][:30], depths[0][30:50], depths[0][50:60] = np.nan, -1, np.inf
    result = filter_depths(grays, cameras, depths, costs, SETTINGS)[0]
    assert not result.valid[:60].any()
    assert result.valid[60:].any()
    assert np.isfinite(result.depth).all()


def test_cameras_with_one_centre_confirm_nothing(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    same = [cameras[0]] * 3
    for result in filter_depths([grays[0]] * 3, same, [depths[0]] * 3, costs, SETTINGS):
        assert not result.valid.any()


def test_views_that_meet_at_too_wide_an_angle_do_not_confirm_each_other(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    outer = [0, 2]  # 30 degrees apart
    kept = {}
    for limit in (60, 15):
        settings = replace(SETTINGS, max_angle=limit)
        parts = [[values[i] for i in outer] for values in (grays, cameras, depths, costs)]
        kept[limit] = filter_depths(*parts, settings)[0].valid.mean()
    assert kept[60] > 0.3 > 10 * kept[15]


def test_more_confirmations_can_be_asked_for(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    kept = []
    for needed in (1, 2, 3):
        settings = replace(SETTINGS, min_sources=needed)
        kept.append(filter_depths(grays, cameras, depths, costs, settings)[1].valid.mean())
    assert kept[0] > kept[1] > 0
    assert kept[2] == kept[1]  # there are only two other views
    count = confirm(1, cameras, depths, SETTINGS).sources
    assert set(np.unique(count)) == {0, 1, 2}


def test_texture_is_the_spread_of_grey_values_in_a_window() -> None:
    image = np.full((40, 80), 120, np.uint8)
    image[:, 40:] = np.random.default_rng(0).integers(0, 255, (40, 40))
    mask = texture_mask(image, StereoSettings(texture_window=11, texture_min=0.02))
    assert not mask[:, :34].any()
    assert mask[:, 46:].all()


def test_small_pieces_are_speckles_and_depth_steps_cut_pieces() -> None:
    depth = np.zeros((40, 60), np.float32)
    depth[5:25, 5:25] = np.linspace(2, 2.2, 20)[None]  # 400 pixels of one slanted surface
    depth[30:34, 30:34] = 3.0  # 16 pixels
    depth[10:14, 25:29] = 4.0  # 16 pixels that touch the surface but lie far behind it
    out = remove_speckles(depth, 50, 0.01)
    np.testing.assert_array_equal(out > 0, (depth > 0) & (depth < 2.5))
    np.testing.assert_array_equal(remove_speckles(depth, 1, 0.01), depth)
    assert not remove_speckles(np.zeros((5, 5)), 50, 0.01).any()

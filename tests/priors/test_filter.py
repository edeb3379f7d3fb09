"""The filter of stereo depth and its sigma: true depth passes where it is seen twice, wrong depth does not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prior_cases import camera_at, plane_seen_by

from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filtering.confirm import confirm
from d2_plugin.priors.stereo.filtering.filter import filter_depths, remove_speckles, surface_coherence, texture_mask
from d2_plugin.priors.stereo.filtering.precision import WINDOW, geometric_sigma, grey_gradient, plane_scatter
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")

SETTINGS = StereoSettings()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=30)


def views(recording: Recording) -> tuple[list, list, list, list]:
    """Grey images, cameras, true depths and perfect costs."""
    depths = [recording.depth(name, 0) for name in recording.cameras]
    grays = [gray(recording.image(name, 0)) for name in recording.cameras]
    return grays, list(recording.cameras.values()), depths, [np.zeros_like(depth) for depth in depths]


def test_true_depth_survives_where_another_view_sees_it(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    for result, depth in zip(filter_depths(grays, cameras, depths, costs, SETTINGS), depths):
        assert (result.depth > 0).mean() > 0.5
        np.testing.assert_array_equal(result.depth[(result.depth > 0)], depth[(result.depth > 0)])
        alone = result.unconfirmed > 0  # what one view sees, and it alone
        assert alone.sum() > 0.25 * (result.depth == 0).sum()
        np.testing.assert_array_equal(result.unconfirmed[alone], depth[alone])
        assert not (result.depth[alone] > 0).any()
        survivors = result.record["survivors"]
        assert list(survivors.values()) == sorted(survivors.values(), reverse=True)
        assert survivors["kept"] == np.count_nonzero(result.depth)


def test_depth_that_is_wrong_in_one_view_is_dropped_there(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    wrong = np.zeros(depths[1].shape, bool)
    wrong[20:60, 40:90] = True
    depths[1] = np.where(wrong, depths[1] * 1.15, depths[1]).astype(np.float32)
    result = filter_depths(grays, cameras, depths, costs, SETTINGS)[1]
    assert (result.depth > 0)[wrong].mean() < 0.02
    assert (result.depth > 0)[~wrong].mean() > 0.4


def test_random_depth_leaves_nearly_nothing(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    rng = np.random.default_rng(0)
    noise = [rng.uniform(2, 8, depth.shape).astype(np.float32) for depth in depths]
    for result in filter_depths(grays, cameras, noise, costs, SETTINGS):
        assert (result.depth > 0).mean() < 0.001
        assert (result.unconfirmed > 0).mean() < 0.001


def test_bad_matches_are_dropped(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    costs[0] = np.full_like(costs[0], 0.51)
    results = filter_depths(grays, cameras, depths, costs, SETTINGS)
    assert not results[0].depth.any()
    assert not results[0].unconfirmed.any()
    # A depth that did not match is not there, so it cannot confirm another view either.
    assert not filter_depths(grays, cameras, depths, costs, replace(SETTINGS, min_sources=2))[1].depth.any()


def test_nan_and_negative_depths_are_no_depths(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    depths[0] = depths[0].copy()
    depths[0][:30], depths[0][30:50], depths[0][50:60] = np.nan, -1, np.inf
    result = filter_depths(grays, cameras, depths, costs, SETTINGS)[0]
    assert not (result.depth > 0)[:60].any()
    assert (result.depth > 0)[60:].any()
    assert np.isfinite(result.depth).all()


def test_more_confirmations_can_be_asked_for(recording: Recording) -> None:
    grays, cameras, depths, costs = views(recording)
    asked = [replace(SETTINGS, min_sources=needed) for needed in (1, 2, 3)]
    kept = [filter_depths(grays, cameras, depths, costs, one)[1].depth.astype(bool).mean() for one in asked]
    assert kept[0] > kept[1] > 0
    assert kept[2] == kept[1]  # there are only two other views
    assert set(np.unique(confirm(1, cameras, depths, SETTINGS).sources)) == {0, 1, 2}
    crowd = ([one[1], *[one[0]] * 256] for one in (cameras, depths))
    assert set(np.unique(confirm(0, *crowd, SETTINGS).sources)) == {0, 256}


def test_texture_is_the_spread_of_grey_values_in_a_window() -> None:
    image = np.full((40, 80), 120, np.uint8)
    image[:, 40:] = np.random.default_rng(0).integers(0, 255, (40, 40))
    mask = texture_mask(image)
    assert not mask[:, :34].any()
    assert mask[:, 46:].all()


def test_small_pieces_are_speckles_and_depth_steps_cut_pieces() -> None:
    depth = np.zeros((40, 60), np.float32)
    depth[5:25, 5:25] = np.linspace(2, 2.2, 20)[None]  # 400 pixels of one slanted surface
    depth[30:34, 30:34] = 3.0  # 16 pixels
    depth[10:14, 25:29] = 4.0  # 16 pixels that touch the surface but lie far behind it
    np.testing.assert_array_equal(remove_speckles(depth) > 0, (depth > 0) & (depth < 2.5))
    assert not remove_speckles(np.zeros((5, 5))).any()


SHAPE = (40, 60)


def plane(slope_x: float, slope_y: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Depth of a plane: inverse depth is linear over the image."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (1 / (0.25 + slope_x * (u - shape[1] / 2) + slope_y * (v - shape[0] / 2))).astype(np.float32)


def coherence(depth: np.ndarray, gray: np.ndarray | None = None) -> np.ndarray:
    return surface_coherence(np.full(SHAPE, 128, np.uint8) if gray is None else gray, depth)


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.003, 0.003), st.floats(-0.003, 0.003), st.floats(1e-3, 1e3))
def test_a_slanted_plane_of_any_scale_is_coherent(slope_x: float, slope_y: float, scale: float) -> None:
    assert coherence(plane(slope_x, slope_y) * np.float32(scale))[10:-10, 10:-10].min() > 0.99


def test_a_wrong_piece_of_a_plane_is_not_coherent_and_leaves_its_surroundings_alone() -> None:
    depth = plane(0.001, 0.0)
    depth[18:22, 28:32] *= 1.1
    share = coherence(depth)
    assert share[18:22, 28:32].max() < 0.5
    assert share[18:22, 38:52].min() > 0.9


def test_a_depth_edge_along_an_edge_of_the_image_stays_coherent() -> None:
    depth, gray = plane(0.0, 0.0), np.full(SHAPE, 80, np.uint8)
    depth[:, 30:], gray[:, 30:] = 8.0, 200
    assert coherence(depth, gray)[10:-10, 28].min() > 0.9
    assert coherence(depth)[10:-10, 29].max() < 0.7  # without the image's help the far side counts against it


WIDTH, HEIGHT, BASELINE = 96, 64, 0.5


def sources(slope: float, between: bool) -> tuple[np.ndarray, np.ndarray]:
    """(how many sources confirm each exact depth of the left camera, that depth) of a ground y = 1 + slope x."""
    cameras = [camera_at((x, 0, 0), size=(WIDTH, HEIGHT), focal=90, principal=(0.5, 1 / 8)) for x in (0, BASELINE)]
    depths = [plane_seen_by(view, (-slope, 1, 0), 1).astype(np.float32) for view in cameras]
    return confirm(0, cameras, depths, StereoSettings(between_pixels=between, min_angle=0.1)).sources, depths[0]


def test_a_ground_at_a_grazing_angle_is_confirmed_between_pixels_and_not_at_them() -> None:
    confirmed_share = {}
    for between in (False, True):
        confirmed, depth = sources(1.0, between)
        grazing = (depth > 2) & (depth < 8)
        grazing[:, :30] = False  # leaves the other image
        confirmed_share[between] = float((confirmed[grazing] > 0).mean())
    assert confirmed_share[True] > 0.9
    assert confirmed_share[False] < 0.7


def sigma_of(depth: np.ndarray) -> np.ndarray:
    """Sigma with full coherence, no spread, a textured image and a parallax of 100 pixels."""
    values = {"coherence": 1.0, "parallax": 100.0, "spread": 0.0, "gradient": 0.05}
    return geometric_sigma(depth, **{name: np.broadcast_to(value, depth.shape) for name, value in values.items()})


@pytest.mark.parametrize("unit", [1e-3, 1e6])
def test_a_plane_does_not_scatter_whatever_the_unit_and_the_size(unit: float) -> None:
    assert plane_scatter(plane(7e-5, 5e-5, (1014, 1352)) * np.float32(unit)).max() < 2e-5


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_the_scatter_is_the_noise(noise: float) -> None:
    depth = plane(6e-4, 4e-4, (120, 160))
    noisy = depth * np.exp(noise * np.random.default_rng(0).standard_normal(depth.shape))
    # Of the window's WINDOW^2 values the plane takes three.
    expected = noise * np.sqrt(1 - 3 / WINDOW**2)
    assert np.sqrt(np.mean(plane_scatter(noisy)[4:-4, 4:-4] ** 2)) == pytest.approx(expected, rel=0.03)
    assert np.median(sigma_of(noisy)) > np.median(sigma_of(depth))


def test_a_flat_part_beside_a_textured_one_has_a_gradient() -> None:
    image = np.zeros((180, 320), np.uint8)
    image[:, :107] = np.random.default_rng(2).integers(0, 255, (180, 107))
    gradient = grey_gradient(image)
    assert np.isfinite(gradient).all()
    assert gradient[:, 150:].max() < 1e-6

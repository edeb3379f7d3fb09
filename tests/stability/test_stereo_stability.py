"""Stereo at the edge (case 44 of the inventory): empty or refused, never a plausible map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from d2_plugin.compiler import NoCompiler, find_compiler
from d2_plugin.errors import D2Error
from d2_plugin.priors.colmap.mvs import why_not_usable
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.depth_range import depth_bounds
from d2_plugin.priors.stereo.geometric_depth import geometric_depth
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")

BOUNDS = (2.0, 9.0)


@pytest.fixture(params=["patchmatch", "colmap"])
def matcher(request: pytest.FixtureRequest) -> str:
    """Every matcher that this machine has."""
    if request.param == "patchmatch":
        try:
            find_compiler()
        except NoCompiler:
            pytest.skip("there is no C++ compiler for patchmatch")
    if request.param == "colmap" and (reason := why_not_usable()):
        pytest.skip(f"COLMAP's PatchMatch cannot run: {reason}")
    return request.param


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[Camera]]:
    recording = synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=20)
    return [recording.image(name, 0) for name in recording.cameras], list(recording.cameras.values())


def valid_share(images: list[np.ndarray], cameras: list[Camera], matcher: str) -> float:
    results = geometric_depth(images, cameras, BOUNDS, StereoSettings(matcher=matcher))
    for result in results:
        assert np.isfinite(result.depth).all()
    return max(float((result.depth > 0).mean()) for result in results)


def test_two_views_are_enough(views: tuple, matcher: str) -> None:
    images, cameras = views
    assert valid_share(images[:2], cameras[:2], matcher) > 0.05


def test_a_frame_without_texture_has_no_depth(views: tuple, matcher: str) -> None:
    images, cameras = views
    assert valid_share([np.full_like(image, 128) for image in images], cameras, matcher) == 0


def test_faint_noise_on_a_plain_wall_has_next_to_no_depth(views: tuple, matcher: str) -> None:
    images, cameras = views
    rng = np.random.default_rng(0)
    noise = [np.clip(128 + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in images]
    assert valid_share(noise, cameras, matcher) < 0.01


def test_identical_cameras_have_no_depth(views: tuple, matcher: str) -> None:
    images, cameras = views
    assert valid_share([images[0]] * 3, [cameras[0]] * 3, matcher) == 0


def test_a_pure_rotation_has_no_depth(views: tuple, matcher: str) -> None:
    images, cameras = views
    turn = np.eye(4)
    turn[:2, :2] = [[0.999, -0.0447], [0.0447, 0.999]]
    turned = replace(cameras[0], name="turned", T_camera_world=turn @ cameras[0].T_camera_world)
    assert valid_share([images[0], images[0]], [cameras[0], turned], matcher) == 0


def test_one_black_image_neither_has_depth_nor_takes_it_from_the_others(views: tuple, matcher: str) -> None:
    images, cameras = views
    results = geometric_depth(
        [images[0], np.zeros_like(images[1]), images[2]], cameras, BOUNDS, StereoSettings(matcher=matcher)
    )
    assert not results[1].depth.any()
    whole = geometric_depth(images[::2], cameras[::2], BOUNDS, StereoSettings(matcher=matcher))
    assert (results[0].depth > 0).mean() > 0.5 * (whole[0].depth > 0).mean()


@pytest.mark.parametrize("bounds", [(9.0, 2.0), (0.0, 2.0), (2.0, 2.0), (2.0, float("nan"))])
def test_an_inverted_depth_range_is_refused(views: tuple, matcher: str, bounds: tuple[float, float]) -> None:
    images, cameras = views
    with pytest.raises(D2Error, match="swap or correct"):
        geometric_depth(images, cameras, bounds, StereoSettings(matcher=matcher))


def test_no_depth_range_follows_from_cameras_at_one_point(views: tuple) -> None:
    first = replace(views[1][0], near_far=None)
    with pytest.raises(D2Error, match="stand at one point"):
        depth_bounds([first, replace(first, name="again")])


def test_one_view_is_refused(views: tuple, matcher: str) -> None:
    images, cameras = views
    with pytest.raises(D2Error, match="at least 2 cameras"):
        geometric_depth(images[:1], cameras[:1], BOUNDS, StereoSettings(matcher=matcher))


def test_views_that_do_not_overlap_have_no_depth(views: tuple, matcher: str) -> None:
    images, cameras = views
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned = replace(cameras[1], T_camera_world=away @ cameras[1].T_camera_world)
    assert valid_share(images[:2], [cameras[0], turned], matcher) == 0

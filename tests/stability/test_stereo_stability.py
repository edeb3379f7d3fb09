"""Stereo at the edge (case 44 of the inventory): empty or refused, never a plausible map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from d2_plugin.compiler import NoCompiler, find_compiler
from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.depth_range import depth_bounds
from d2_plugin.priors.stereo.geometric_depth import geometric_depth
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")
try:
    find_compiler()
except NoCompiler:
    pytest.skip("there is no C++ compiler for patchmatch", allow_module_level=True)

BOUNDS = (2.0, 9.0)


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[Camera]]:
    recording = synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=20)
    return [recording.image(name, 0) for name in recording.cameras], list(recording.cameras.values())


def valid_share(images: list[np.ndarray], cameras: list[Camera]) -> float:
    results = geometric_depth(images, cameras, BOUNDS, StereoSettings())
    for result in results:
        assert np.isfinite(result.depth).all()
    return max(float((result.depth > 0).mean()) for result in results)


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    return replace(camera, name="turned", T_camera_world=turn @ camera.T_camera_world)


SLIGHTLY = np.array([[0.999, -0.0447, 0, 0], [0.0447, 0.999, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
AWAY = np.diag([-1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize("what", ["no texture", "faint noise", "one camera", "a pure rotation", "no overlap"])
def test_where_nothing_can_be_matched_there_is_next_to_no_depth(views: tuple, what: str) -> None:
    images, cameras = views
    rng = np.random.default_rng(0)
    noise = [np.clip(128 + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in images]
    given = {
        "no texture": ([np.full_like(image, 128) for image in images], cameras),
        "faint noise": (noise, cameras),
        "one camera": ([images[0]] * 3, [cameras[0]] * 3),
        "a pure rotation": ([images[0]] * 2, [cameras[0], turned(cameras[0], SLIGHTLY)]),
        "no overlap": (images[:2], [cameras[0], turned(cameras[1], AWAY)]),
    }
    share = valid_share(*given[what])
    assert share < 0.01 if what == "faint noise" else share == 0


def test_one_black_image_neither_has_depth_nor_takes_it_from_the_others(views: tuple) -> None:
    images, cameras = views
    results = geometric_depth([images[0], np.zeros_like(images[1]), images[2]], cameras, BOUNDS, StereoSettings())
    assert not results[1].depth.any()
    whole = geometric_depth(images[::2], cameras[::2], BOUNDS, StereoSettings())
    assert (results[0].depth > 0).mean() > 0.5 * (whole[0].depth > 0).mean()


def test_no_depth_range_follows_from_cameras_at_one_point(views: tuple) -> None:
    first = replace(views[1][0], near_far=None)
    with pytest.raises(D2Error, match="stand at one point"):
        depth_bounds([first, replace(first, name="again")])

"""The compiled tests of the filter return the bits of the NumPy code, which is what runs where there is no compiler."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.filtering.coherence import surface_coherence
from d2_plugin.priors.stereo.filtering.confirm import Confirmation, confirm
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.patchmatch import patchmatch
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.recording import Camera

pytest.importorskip("cv2")
pytestmark = pytest.mark.skipif(kernel.library() is None, reason="no C++ compiler")

Rig = tuple[list[np.ndarray], list[Camera], list[np.ndarray]]
"""Grey images, cameras, depth maps."""


def cameras(count: int, width: int, height: int, unit: float, seed: int) -> list[Camera]:
    """Cameras side by side that look about along z, `unit` apart."""
    random, views = np.random.default_rng(seed), []
    for index in range(count):
        angle, T = random.normal(0, 0.1), np.eye(4)
        T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        T[:3, 3] = -unit * np.array([index * 0.5, random.normal(0, 0.1), random.normal(0, 0.1)])
        K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        views.append(Camera(name=str(index), width=width, height=height, K=K, T_camera_world=T))
    return views


def random_rig(count: int, width: int, height: int, unit: float, noise: float, seed: int) -> Rig:
    """A wall three units away, noisy and with holes."""
    random = np.random.default_rng(seed)
    shape = (height, width)
    depths = [unit * 3 * np.exp(random.normal(0, noise, shape)) for _ in range(count)]
    depths = [np.where(random.random(shape) < 0.9, depth, 0).astype(np.float32) for depth in depths]
    grays = [random.integers(100, 130, shape).astype(np.uint8) for _ in range(count)]
    return grays, cameras(count, width, height, unit, seed), depths


def judged(rig: Rig, between: bool = True) -> tuple[list[np.ndarray], list[Confirmation]]:
    """(coherence, confirmation) of every view."""
    grays, views, depths = rig
    chosen = StereoSettings(between_pixels=between)
    shares = [surface_coherence(*pair, radius=9, relative=0.01, contrast=0.05) for pair in zip(grays, depths)]
    return shares, [confirm(index, views, depths, chosen) for index in range(len(views))]


def without_compiler(rig: Rig, between: bool = True) -> tuple[list[np.ndarray], list[Confirmation]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "library", lambda: None)
        return judged(rig, between)


def assert_same(one: tuple, other: tuple) -> None:
    for ours, theirs in zip(one[0], other[0]):
        np.testing.assert_array_equal(ours, theirs)
    for ours, theirs in zip(one[1], other[1]):
        for name in Confirmation._fields:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(2, 4),
    width=st.integers(1, 70),
    height=st.integers(1, 40),
    exponent=st.integers(-8, 8),
    noise=st.sampled_from([0.0, 1e-3, 0.02, 1.0]),
    between=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_both_return_the_same_bits(
    count: int, width: int, height: int, exponent: int, noise: float, between: bool, seed: int
) -> None:
    rig = random_rig(count, width, height, 10.0**exponent, noise, seed)
    assert_same(judged(rig, between), without_compiler(rig, between))


def test_the_unit_of_the_world_does_not_matter() -> None:
    """Cross products of float32 coordinates would end at 1e9 of a unit, and below 1e-10 of one."""
    confirmed = []
    for unit in (2.0**-40, 1.0, 2.0**40):
        found = judged(random_rig(3, 60, 40, unit, 1e-3, 0))[1]
        confirmed.append(np.stack([one.sources for one in found]))
    assert confirmed[1].mean() > 0.4
    np.testing.assert_array_equal(confirmed[0], confirmed[1])
    np.testing.assert_array_equal(confirmed[2], confirmed[1])


def test_the_number_of_threads_changes_nothing() -> None:
    rig, before = random_rig(3, 61, 43, 1.0, 1e-3, 1), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(judged(rig))
    finally:
        torch.set_num_threads(before)
    assert_same(*found)


@pytest.mark.parametrize("limits", [(0.0, 180.0), (0.5, 5.0), (29.9, 30.1), (79.0, 90.0)])
def test_rays_meet_between_the_limits(limits: tuple[float, float]) -> None:
    """Two cameras that look along z, the second to the right: its ray to the middle of the wall has a known angle."""
    size, depths = 41, [np.full((41, 41), 3.0, np.float32)] * 2
    chosen = StereoSettings(min_angle=limits[0], max_angle=limits[1], between_pixels=False)
    for degrees in (0.3, 1.0, 4.0, 30.0, 80.0):
        slope = np.tan(np.deg2rad(degrees))
        one = replace(cameras(1, size, size, 1.0, 0)[0], T_camera_world=np.eye(4))
        T, K = np.eye(4), one.K.copy()
        T[0, 3], K[0, 2] = -3 * slope, K[0, 2] + size * slope
        pair = [one, replace(one, T_camera_world=T, K=K)]
        assert confirm(0, pair, depths, chosen).sources[20, 20] == (limits[0] < degrees < limits[1]), degrees


@pytest.mark.parametrize("name", ["studio", "plaza"])
def test_a_real_rig_has_the_same_bits(name: str, shared_data: Callable[[str], Path]) -> None:
    recording = open_recording(shared_data(name))
    chosen = ("00", "02", "05")
    grays = [gray(recording.image(camera, 3)) for camera in chosen]
    views = [recording.cameras[camera] for camera in chosen]
    raw = patchmatch(grays, views, (1.0, 80.0))
    rig = grays, views, [depth for depth, _ in raw]
    assert_same(judged(rig), without_compiler(rig))

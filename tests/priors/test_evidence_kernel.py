"""The compiled questions to the other views answer what the NumPy code does, which runs where there is no compiler."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.priors.cross_view import kernel
from d2_plugin.priors.evidence import with_evidence
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Camera

pytest.importorskip("cv2")
pytestmark = pytest.mark.skipif(kernel.library() is None, reason="no C++ compiler")

TOLERANCE = 0.02

Rig = tuple[dict[str, FusedPrior], dict[str, Camera]]


def camera(center: np.ndarray, angle: float, width: int, height: int, principal: tuple[float, float]) -> Camera:
    """At `center`, turned by `angle` about the vertical; the principal point in shares of the image's size."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = -T[:3, :3] @ center
    K = np.array([[width, 0, principal[0] * width], [0, width, principal[1] * height], [0, 0, 1.0]])
    return Camera("camera", width, height, K, T)


def wall(view: Camera, distance: float) -> np.ndarray:
    """Planar depth [H, W] of the plane z = distance of the world, 0 where a ray does not meet it."""
    u, v = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.K).T
    R = view.T_camera_world[:3, :3]
    toward, center = (rays @ R)[..., 2], -R.T @ view.T_camera_world[:3, 3]
    return np.where(toward > 1e-3, (distance - center[2]) / np.where(toward > 1e-3, toward, 1), 0)


def random_rig(count: int, sizes: list[tuple[int, int]], unit: float, noise: float, colored: bool, seed: int) -> Rig:
    """Views of one wall: maps that differ, surfaces, holes, infinite sigmas, images of different brightness."""
    random, priors, cameras = np.random.default_rng(seed), {}, {}
    for index in range(count):
        width, height = sizes[index]
        center = unit * random.normal(0, 0.3, 3)
        view = camera(center, random.normal(0, 0.1), width, height, tuple(random.normal(0.5, 0.1, 2)))
        shape, truth = (height, width), wall(view, 3 * unit)
        verified = random.random((height // 8 + 1, width // 8 + 1)).repeat(8, 0).repeat(8, 1)[:height, :width] < 0.6
        depth = truth * np.exp(np.where(verified, 0, random.normal(0, noise) + random.normal(0, noise / 9, shape)))
        labels = np.where(verified, Label.VERIFIED, Label.MONO)
        labels = np.where(random.random(shape) < 0.1, random.integers(0, len(Label), shape), labels)
        labels = np.where(depth > 0, labels, Label.EMPTY)
        sigma = np.where(verified, 0.001, random.choice([0.01, 0.1, np.inf], shape))
        colors = np.clip(random.normal(90 + 20 * index, 3, (*shape, 3)), 0, 255) if colored else None
        maps = depth.astype(np.float32), labels.astype(np.uint8), sigma.astype(np.float32)
        priors[str(index)] = FusedPrior(*maps, None if colors is None else colors.astype(np.uint8))
        cameras[str(index)] = view
    return priors, cameras


def without_compiler(rig: Rig, tails: Mapping[str, float] | None = None) -> dict[str, FusedPrior]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "library", lambda: None)
        return with_evidence(*rig, TOLERANCE, tails)


def assert_same(one: Mapping[str, FusedPrior], other: Mapping[str, FusedPrior]) -> None:
    """Every label, and depth and sigma but for the last digit, which logarithms of two libraries may turn."""
    for name, ours in one.items():
        np.testing.assert_array_equal(ours.labels, other[name].labels)
        np.testing.assert_allclose(ours.depth, other[name].depth, rtol=1e-6)
        np.testing.assert_allclose(ours.sigma, other[name].sigma, rtol=1e-6)
        assert (ours.depth.dtype, ours.sigma.dtype) == (np.float32, np.float32)


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.tuples(st.integers(1, 70), st.integers(1, 40)), min_size=2, max_size=4),
    exponent=st.integers(-6, 6),
    noise=st.sampled_from([0.0, 0.01, 0.05, 1.0]),
    colored=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_both_answer_the_same(
    sizes: list[tuple[int, int]], exponent: int, noise: float, colored: bool, seed: int
) -> None:
    rig = random_rig(len(sizes), sizes, 10.0**exponent, noise, colored, seed)
    tails = {"0": 2.0, "1": float("nan")}
    assert_same(with_evidence(*rig, TOLERANCE, tails), without_compiler(rig, tails))


def test_the_random_rigs_ask_every_question() -> None:
    """Else the test above would compare nothing."""
    priors, cameras = random_rig(3, [(70, 40)] * 3, 1.0, 0.02, True, 1)
    asked = with_evidence(priors, cameras, TOLERANCE)
    changes = {int(label) for name in priors for label in asked[name].labels[asked[name].labels != priors[name].labels]}
    assert changes == {int(Label.AGREED), int(Label.VERIFIED)}


def test_the_number_of_threads_changes_nothing() -> None:
    rig, before = random_rig(4, [(61, 43)] * 4, 1.0, 0.02, True, 1), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(with_evidence(*rig, TOLERANCE))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for name, prior in found[0].items():
            for map_ in ("labels", "depth", "sigma"):
                np.testing.assert_array_equal(getattr(prior, map_), getattr(other[name], map_), map_)


@pytest.mark.parametrize("value", [0.0, 1e-45, 1e-6, 1e6, 3e38, np.inf, -1.0, np.nan])
@pytest.mark.parametrize("map_", ["depth", "sigma"])
def test_both_agree_on_numbers_that_no_prior_should_hold(map_: str, value: float) -> None:
    priors, cameras = random_rig(3, [(40, 30)] * 3, 1.0, 0.02, True, 2)
    for prior in priors.values():
        getattr(prior, map_)[::3, 1::2] = value
    with np.errstate(all="ignore"):
        assert_same(with_evidence(priors, cameras, TOLERANCE), without_compiler((priors, cameras)))


PLACES = {
    "on one spot": (0.0, 0.0, 0.0),
    "at the wall": (0.0, 0.0, 3.0),
    "behind the wall": (0.0, 0.0, 5.0),
    "far away": (1e12, 0.0, 0.0),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("turned", [0.0, np.pi / 2, np.pi])
@pytest.mark.parametrize("principal", [(0.5, 0.5), (-2.0, 9.0)])
def test_both_agree_wherever_the_other_camera_stands(place: str, turned: float, principal: tuple[float, float]) -> None:
    priors, cameras = random_rig(2, [(40, 30)] * 2, 1.0, 0.02, True, 3)
    cameras["0"] = camera(np.zeros(3), 0.0, 40, 30, (0.5, 0.5))
    cameras["1"] = camera(np.array(PLACES[place]), turned, 40, 30, principal)
    with np.errstate(all="ignore"):
        assert_same(with_evidence(priors, cameras, TOLERANCE), without_compiler((priors, cameras)))


def test_a_point_at_the_centre_of_another_camera_is_nowhere_in_its_image() -> None:
    ours = camera(np.zeros(3), 0.0, 41, 31, (20.5 / 41, 15.5 / 31))
    theirs = camera(np.array([0, 0, 2.0]), 0.0, 41, 31, (20.5 / 41, 15.5 / 31))
    shape = (31, 41)
    prior = FusedPrior(np.full(shape, 2, np.float32), np.full(shape, 1, np.uint8), np.full(shape, 0.1, np.float32))
    asked = with_evidence({"ours": prior, "theirs": prior}, {"ours": ours, "theirs": theirs}, TOLERANCE)["ours"]
    assert (asked.labels == Label.MONO).all()
    np.testing.assert_array_equal(asked.sigma, prior.sigma)


def test_maps_of_another_order_in_memory_are_read_alike_and_left_as_they_are() -> None:
    priors, cameras = random_rig(3, [(40, 30)] * 3, 1.0, 0.02, True, 4)
    turned = {
        name: FusedPrior(*(np.asfortranarray(map_) for map_ in (prior.depth, prior.labels, prior.sigma, prior.colors)))
        for name, prior in priors.items()
    }
    before = {name: prior.labels.copy() for name, prior in turned.items()}
    assert_same(with_evidence(priors, cameras, TOLERANCE), with_evidence(turned, cameras, TOLERANCE))
    for name, prior in turned.items():
        np.testing.assert_array_equal(prior.labels, before[name])


def test_the_gain_is_the_median_halfway_between_the_middle_two_of_an_even_number() -> None:
    """Both verified the left half, where the other image is 1 to 1.3 times brighter; the right half tells."""
    view, shape = camera(np.zeros(3), 0.0, 40, 30, (0.5, 0.5)), (30, 40)
    left, top = np.arange(40)[None] < 20, np.arange(30)[:, None] < 15
    labels = np.broadcast_to(np.where(left, Label.VERIFIED, Label.MONO), shape).astype(np.uint8)
    theirs = np.where(left, np.where(top, 100, 130), 103)
    depth, sigma = np.full(shape, 4, np.float32), np.full(shape, 0.05, np.float32)
    greys = {"ours": np.full(shape, 100), "theirs": theirs}
    priors = {
        name: FusedPrior(depth, labels, sigma, np.repeat(grey[..., None], 3, -1).astype(np.uint8))
        for name, grey in greys.items()
    }
    rig = priors, {"ours": view, "theirs": view}
    asked = with_evidence(*rig, TOLERANCE)
    assert (asked["ours"].labels[:, 22:] == Label.AGREED).all(), "the larger of the two is too bright for it"
    assert_same(asked, without_compiler(rig))

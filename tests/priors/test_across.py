"""Slopes from surfaces that maps share: right where anchors cannot tell them, nothing where maps do not belong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import camera_at

from d2_plugin.priors.build import build_priors
from d2_plugin.priors.monocular.across import Shown, aligned_across, is_open
from d2_plugin.priors.monocular.align import Alignment, AlignStatus, align
from d2_plugin.priors.monocular.settings import AlignSettings
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.recording import MonoKind, Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

cv2 = pytest.importorskip("cv2")
ALIGN = AlignSettings()
SIDE = 16
"""Of the one patch that stereo knows, pixels."""


@pytest.fixture(scope="module")
def room() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=1, width=160, height=90, arc_degrees=80)


def patch(depth: np.ndarray, seed: int) -> np.ndarray:
    """The depths of one small square, the flattest of some, .4 % off at its ends; 0 elsewhere."""
    rng = np.random.default_rng(seed)
    corners = [[rng.integers(0, size - SIDE) for size in depth.shape] for _ in range(100)]
    squares = [np.s_[row : row + SIDE, column : column + SIDE] for row, column in corners]
    flattest = min(squares, key=lambda square: depth[square].max() / max(depth[square].min(), 1e-9))
    known = np.zeros_like(depth)
    known[flattest] = depth[flattest] * (1 + 0.004 * np.linspace(-1, 1, SIDE))
    return known


def shown(
    room: Recording, kind: MonoKind = "relative", turned: Callable | None = None, unit: float = 1.0
) -> dict[str, Shown]:
    """Each camera with a map that is exact but for its line (or `turned`), and one patch of depth, in `unit`s."""
    views = {}
    for number, (name, camera) in enumerate(room.cameras.items()):
        depth = room.depth(name, 0).astype(np.float64)
        mono = ((1 / depth if kind == "relative" else depth) - 0.02 * number) / (0.5 + number)
        mono = (mono if turned is None else turned(name, mono)).astype(np.float32)
        pose = np.array(camera.T_camera_world)
        pose[:3, 3] *= unit
        geometric = (unit * patch(depth, number)).astype(np.float32)
        alignment = align(mono, geometric, kind=kind, settings=ALIGN)
        views[name] = Shown(replace(camera, T_camera_world=pose), mono, geometric, alignment)
    return views


def anchored(view: Shown, geometric: np.ndarray) -> Shown:
    geometric = geometric.astype(np.float32)
    alignment = align(view.mono, geometric, kind="relative", settings=ALIGN)
    return view._replace(geometric=geometric, alignment=alignment)


def error(room: Recording, name: str, view: Shown, scale: float, shift: float, kind: MonoKind = "relative") -> float:
    """Median relative error of the depth that a line gives."""
    turned = scale * view.mono.astype(np.float64) + shift
    depth = 1 / np.maximum(turned, 1e-6) if kind == "relative" else turned
    return float(np.median(np.abs(depth / room.depth(name, 0) - 1)))


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_the_slopes_are_found_that_one_patch_of_depth_leaves_open(room: Recording, kind: MonoKind) -> None:
    views = shown(room, kind)
    assert all(is_open(view) for view in views.values())
    found = aligned_across(views, kind)
    assert set(found) == set(views)
    before = [error(room, name, view, *line(view.alignment), kind) for name, view in views.items()]
    after = [error(room, name, views[name], *line(alignment), kind) for name, alignment in found.items()]
    assert max(after) < 0.03
    assert max(before) > 2 * max(after)
    for alignment in found.values():
        assert alignment.status is AlignStatus.ACROSS
        assert alignment.accepted
        assert alignment.across < 0.1


def test_a_floor_below_cameras_of_one_height_fits_with_every_slope_so_a_metric_map_keeps_its_own() -> None:
    rows = np.arange(90)[:, None] + 0.5 + np.zeros((1, 160))
    depth = 1.5 * 100 / np.maximum(rows - 30, 10)  # 1.5 below a camera of focal length 100
    views = {}
    for number in range(2):
        pose = np.eye(4)
        pose[0, 3] = -0.5 * number
        camera = replace(camera_at(size=(160, 90)), K=np.array([[100.0, 0, 80], [0, 100, 30], [0, 0, 1]]))
        mono = np.where(rows > 40, depth, np.nan).astype(np.float32)
        geometric = np.where((rows > 60) & (rows < 63) & (np.arange(160) < 99), depth, 0).astype(np.float32)
        alignment = align(mono, geometric, kind="metric", settings=ALIGN)
        views[str(number)] = Shown(replace(camera, T_camera_world=pose), mono, geometric, alignment)
    found = aligned_across(views, "metric")
    assert set(found) == set(views)
    for name, alignment in found.items():
        np.testing.assert_allclose(alignment.scale * views[name].mono[41:] + alignment.shift, depth[41:], rtol=0.2)
        assert alignment.across >= 0.01, "a map that was bent by anchors is not known better"


def line(alignment: Alignment) -> tuple[float, float]:
    return alignment.scale, alignment.shift


def test_neither_the_unit_of_the_world_nor_that_of_a_map_matters() -> None:
    room = synthetic_recording(cameras=2, held_out=0, frames=1, width=96, height=54, arc_degrees=60)
    views = shown(room)
    plain = aligned_across(views, "relative")
    for world, scale, shift in ((6, -6, 5), (-6, 6, -5)):
        others = shown(room, turned=lambda _, mono: (mono + shift) * 10.0**scale, unit=10.0**world)  # noqa: B023
        scaled = aligned_across(others, "relative")
        assert set(plain) == set(scaled)
        for name, view in others.items():
            depth = 1 / (scaled[name].scale * view.mono.astype(np.float64) + scaled[name].shift) / 10.0**world
            expected = 1 / (plain[name].scale * views[name].mono + plain[name].shift)
            assert np.median(np.abs(depth / expected - 1)) < 0.02


def test_maps_with_spread_anchors_keep_their_lines_and_help_the_others(room: Recording) -> None:
    views = shown(room)
    chosen = np.random.default_rng(0).random((90, 160)) < 0.05
    spread = {name: anchored(view, room.depth(name, 0) * chosen) for name, view in views.items()}
    assert aligned_across(spread, "relative") == {}, "nothing is open"
    one = next(iter(views))
    found = aligned_across({**spread, one: views[one]}, "relative")
    assert error(room, one, views[one], *line(found[one])) < 0.03
    for name in set(spread) - {one}:
        assert found[name].status is AlignStatus.OK
        assert line(found[name]) == line(spread[name].alignment)
        assert found[name].across < 0.1, "how far the map parts from the others is told as well"


def noise(name: str, mono: np.ndarray) -> np.ndarray:
    lumps = cv2.GaussianBlur(np.random.default_rng(len(name)).random(mono.shape), (0, 0), 5)
    return mono.min() + np.ptp(mono) * (lumps - lumps.min()) / np.ptp(lumps)


def turned(name: str, mono: np.ndarray) -> np.ndarray:
    """Mirrored, upside down or both: in no two cameras the same."""
    return [mono[:, ::-1], mono[::-1], mono[::-1, ::-1]][int(name[-1])]


@pytest.mark.parametrize("wrong", [noise, turned, lambda name, mono: mono.max() - mono])
def test_maps_that_show_no_common_surface_are_told_nothing(room, wrong) -> None:
    views = shown(room, turned=wrong)
    assert not [view for view in aligned_across(views, "relative").values() if view.status is AlignStatus.ACROSS]


def test_one_wrong_map_is_left_out_and_the_others_are_told(room: Recording) -> None:
    last = list(room.cameras)[-1]
    views = shown(room, turned=lambda name, mono: mono[::-1, ::-1] if name == last else mono)
    found = aligned_across(views, "relative")
    assert set(found) == set(views) - {last}
    assert max(error(room, name, views[name], *line(found[name])) for name in found) < 0.05


class TestStiff:
    def test_a_map_without_anchors_is_left_out(self, room: Recording) -> None:
        views = shown(room)
        first = next(iter(views))
        found = aligned_across(views | {first: anchored(views[first], 0 * views[first].geometric)}, "relative")
        assert set(found) == set(views) - {first}

    def test_a_depth_map_that_is_negative_at_its_anchors_has_no_slopes_to_try(self) -> None:
        floor = np.linspace(8, 2, 90, dtype=np.float32)[:, None].repeat(160, 1)  # the same from side to side
        known = floor * ((np.indices(floor.shape)[0] // 6 == 7) & (np.arange(160) < 60))
        found = align(floor - 20, known, kind="metric", settings=ALIGN)
        cameras = [camera_at((x, 0, 0), size=(160, 90)) for x in (0, 0.3, 0.6)]
        views = {str(n): Shown(camera, floor - 20, known, found) for n, camera in enumerate(cameras)}
        assert aligned_across(views, "metric") == {}

    @pytest.mark.parametrize("value", [np.nan, 0.0])
    def test_pixels_without_a_prediction_are_asked_nothing(self, room: Recording, value: float) -> None:
        def half(name: str, mono: np.ndarray) -> np.ndarray:
            return np.where(np.indices(mono.shape).sum(0) % 2 == 0, value, mono)

        whole, found = shown(room), aligned_across(shown(room, turned=half), "relative")
        assert max(error(room, name, whole[name], *line(found[name])) for name in found) < 0.03

    def test_cameras_that_look_away_from_each_other_tell_nothing(self, room: Recording) -> None:
        views = shown(room)
        one, other = list(views)[:2]
        back = np.array(views[other].camera.T_camera_world)
        back[[0, 2]] *= -1  # about its own vertical axis
        away = replace(views[other].camera, T_camera_world=back)
        assert aligned_across({one: views[one], other: views[other]._replace(camera=away)}, "relative") == {}


def test_two_cameras_far_apart_outdoors(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """plaza from 02 and 05, 64 degrees apart, stereo looking far away alone: it knows a tower, the maps know more."""
    recording = replace(open_recording(shared_data("plaza")), frames=(10,))
    errors = {}
    for across in (False, True):
        prior = PriorSettings(depth_range=(15.0, 40.0), align=AlignSettings(across=across))
        build_priors(recording, ["02", "05"], tmp_path, prior)
        for camera in ("02", "05"):
            found, truth = PriorStore.open(tmp_path).prior(camera, 10), recording.depth(camera, 10)
            known = (found.depth.numpy() > 0) & (truth > 0)
            apart = np.abs(found.depth.numpy() / np.where(known, truth, 1) - 1)[known]
            errors[across, camera] = float(np.median(apart)), known.mean()
            if across:
                sigma = found.sigma.numpy()[known]
                assert np.mean(np.isfinite(sigma)) > 0.9
                assert np.mean(apart < 2 * sigma) > 0.85
    assert max(errors[True, camera][0] for camera in ("02", "05")) < 0.12
    assert min(errors[True, camera][1] for camera in ("02", "05")) > 0.4
    wrong = [errors[False, camera][0] > 0.5 or errors[False, camera][1] < 0.1 for camera in ("02", "05")]
    assert all(wrong), errors

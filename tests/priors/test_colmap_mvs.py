"""COLMAP's PatchMatch: its workspace says what we know, and nothing that goes wrong in it goes unnoticed."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import write_dense_array

from benchmarks.stereo_measure import score
from benchmarks.stereo_rigs import Rig, textured_rig
from d2_plugin.errors import D2Error
from d2_plugin.priors.colmap import mvs as colmap_mvs
from d2_plugin.priors.colmap.mvs import (
    NO_MATCH,
    colmap_patch_match,
    mutual_sources,
    patch_match_options,
    run_patch_match,
    why_not_usable,
    write_workspace,
)
from d2_plugin.priors.colmap.workspace import read_dense_array
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.filtering.filter import filter_depths
from d2_plugin.priors.stereo.geometric_depth import MATCHERS, choose_matcher, gray

pytest.importorskip("cv2")

SETTINGS = StereoSettings(matcher="colmap")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return textured_rig(3, width=160, height=90, seed=3)


@pytest.fixture(scope="module")
def grays(rig: Rig) -> list[np.ndarray]:
    return [gray(image) for image in rig.images]


def oracle(rig: Rig, kind: str = "geometric", **changes: object):
    """A runner that leaves the true depth of every listed view, except for what `changes` puts in its place."""

    def run(workspace: Path, seconds: float) -> None:
        for name in (workspace / "stereo" / "patch-match.cfg").read_text().splitlines()[::2]:
            depth = changes.get(name, rig.truths[int(name[:4])])
            if depth is not None:
                write_dense_array(workspace / "stereo" / "depth_maps" / f"{name}.{kind}.bin", depth)

    return run


def test_colmap_itself_reads_the_same_depth_map(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    depth = np.random.default_rng(0).uniform(1, 5, (7, 9)).astype(np.float32)
    write_dense_array(tmp_path / "depth.bin", depth)
    read = pycolmap.DepthMap()
    read.read(tmp_path / "depth.bin")
    np.testing.assert_array_equal(np.asarray(read.to_array()).reshape(7, 9), depth)


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"", "does not begin"), (b"depth", "does not begin"), (b"3&2&1&" + bytes(20), "20 bytes .* need 24")],
)
def test_a_damaged_map_is_named(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "map.bin").write_bytes(data)
    with pytest.raises(D2Error, match=f"map.bin .*{message}"):
        read_dense_array(tmp_path / "map.bin")
    with pytest.raises(D2Error, match="cannot read"):
        read_dense_array(tmp_path / "absent.bin")


def test_colmap_finds_our_cameras_in_the_workspace(rig: Rig, grays: list[np.ndarray], tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_workspace(tmp_path, grays, rig.cameras, [[1, 2], [0], []], patch_match_options((1.0, 9.0), SETTINGS))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    for number, camera in enumerate(rig.cameras, start=1):
        image = model.images[number]
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera.T_camera_world[:3], atol=1e-12)
        K = model.cameras[image.camera_id].calibration_matrix()
        np.testing.assert_allclose(K[:2, 2], camera.K[:2, 2] - 0.5)  # array indices, which its PatchMatch takes
        np.testing.assert_allclose(np.diag(K)[:2], np.diag(camera.K)[:2])
    dense = pycolmap.MVSModel()
    dense.read_from_colmap(tmp_path)
    assert [dense.get_image_name(index) for index in range(3)] == ["0000.png", "0001.png", "0002.png"]
    listed = (tmp_path / "stereo" / "patch-match.cfg").read_text()
    assert listed == "0000.png\n0001.png, 0002.png\n0001.png\n0000.png\n"
    options = pycolmap.PatchMatchOptions()
    for name, value in json.loads((tmp_path / "options.json").read_text()).items():
        assert type(getattr(options, name)) in (type(value), float)
        setattr(options, name, value)
    assert (options.depth_min, options.depth_max, options.filter_min_triangulation_angle) == (1.0, 9.0, 1.0)


def test_maps_that_colmap_leaves_go_through_the_common_filter(rig: Rig, grays: list[np.ndarray]) -> None:
    raw = colmap_patch_match(grays, rig.cameras, rig.depth_range, SETTINGS, run=oracle(rig))
    filtered = filter_depths(grays, rig.cameras, *map(list, zip(*raw)), SETTINGS)
    found = score([result.depth for result in filtered], rig.truths, rig.covisible)
    assert found.completeness > 0.7
    assert found.median == 0


def test_depth_out_of_range_is_dropped_since_colmap_may_leave_it(rig: Rig, grays: list[np.ndarray]) -> None:
    middle = float(np.median(rig.truths[0]))
    raw = colmap_patch_match(grays, rig.cameras, (middle, 100.0), SETTINGS, run=oracle(rig))
    depth, cost = raw[0]
    assert depth[depth > 0].min() >= middle
    np.testing.assert_array_equal(cost == NO_MATCH, depth == 0)
    assert 0.4 < (depth > 0).mean() < 0.6


def test_photometric_maps_are_read_where_the_geometric_pass_is_off(rig: Rig, grays: list[np.ndarray]) -> None:
    quick = replace(SETTINGS, colmap_geometric=False)
    raw = colmap_patch_match(grays, rig.cameras, rig.depth_range, quick, run=oracle(rig, "photometric"))
    assert all(depth.any() for depth, _ in raw)
    assert not patch_match_options((1.0, 2.0), quick)["geom_consistency"]


def test_a_view_that_no_other_meets_is_not_asked_for(rig: Rig, grays: list[np.ndarray]) -> None:
    away = rig.cameras[2].T_camera_world.copy()
    away[:3] = np.diag([-1.0, 1.0, -1.0]) @ away[:3]  # turned by half a turn about its vertical axis
    cameras = [*rig.cameras[:2], replace(rig.cameras[2], T_camera_world=away)]
    raw = colmap_patch_match(grays, cameras, rig.depth_range, SETTINGS, run=oracle(rig))
    assert [bool(depth.any()) for depth, _ in raw] == [True, True, False]


def test_a_view_without_sources_is_no_source_either_since_colmap_would_miss_its_map() -> None:
    assert mutual_sources([[1, 2], [0], [0]]) == [[1, 2], [0], [0]]
    assert mutual_sources([[1, 2], [0], []]) == [[1], [0], []]
    assert mutual_sources([[1], [2], []]) == [[], [], []]


def test_cameras_on_one_spot_need_no_colmap_to_have_no_depth(rig: Rig, grays: list[np.ndarray]) -> None:
    def run(workspace: Path, seconds: float) -> None:
        raise AssertionError("there is nothing to match")

    raw = colmap_patch_match(grays[:2], [rig.cameras[0]] * 2, rig.depth_range, SETTINGS, run=run)
    assert not any(depth.any() for depth, _ in raw)


@pytest.mark.parametrize(
    ("left", "message"),
    [
        (None, "left no 0001.png.geometric.bin for camera"),
        (np.ones((45, 80), np.float32), r"is \(80, 45\) pixels but its image is \(160, 90\)"),
        (np.full((90, 160), np.nan, np.float32), "14400 values that are not finite"),
    ],
)
def test_what_colmap_leaves_is_checked(rig: Rig, grays: list[np.ndarray], left: np.ndarray, message: str) -> None:
    with pytest.raises(D2Error, match=message):
        colmap_patch_match(grays, rig.cameras, rig.depth_range, SETTINGS, run=oracle(rig, **{"0001.png": left}))


def test_no_depth_at_all_is_told(rig: Rig, grays: list[np.ndarray], caplog: pytest.LogCaptureFixture) -> None:
    empty = {f"{index:04d}.png": np.zeros((90, 160), np.float32) for index in range(3)}
    raw = colmap_patch_match(grays, rig.cameras, rig.depth_range, SETTINGS, run=oracle(rig, **empty))
    assert not any(depth.any() for depth, _ in raw)
    assert "no depth in any view" in caplog.text


def test_an_abort_of_colmap_leaves_us_alive_with_its_last_words(tmp_path: Path) -> None:
    words = "import os, sys; print('Check failed: no GPU', file=sys.stderr); print('    @ 0x1 abort', file=sys.stderr)"
    with pytest.raises(D2Error, match=r"ended with signal SIGABRT \(Check failed: no GPU\)"):
        run_patch_match(tmp_path, 60, [sys.executable, "-c", f"{words}; sys.stderr.flush(); os.abort()"])
    with pytest.raises(D2Error, match=r"exit code 3 \(without a word\)"):
        run_patch_match(tmp_path, 60, [sys.executable, "-c", "raise SystemExit(3)"])


def test_a_colmap_that_never_ends_is_ended(tmp_path: Path) -> None:
    with pytest.raises(D2Error, match="more than 0.005 minutes"):
        run_patch_match(tmp_path, 0.3, [sys.executable, "-c", "import time; time.sleep(60)"])


def test_the_child_process_reaches_colmap(rig: Rig, grays: list[np.ndarray], tmp_path: Path) -> None:
    """Without CUDA it comes as far as COLMAP's own refusal: options and workspace were taken."""
    pytest.importorskip("pycolmap")
    if not why_not_usable():
        pytest.skip("COLMAP has a GPU here and would not refuse")
    write_workspace(tmp_path, grays, rig.cameras, [[1], [0], [0]], patch_match_options(rig.depth_range, SETTINGS))
    with pytest.raises(D2Error, match="COLMAP's PatchMatch ended with .*CUDA"):
        run_patch_match(tmp_path, 120)


def test_colmap_finds_the_room(rig: Rig, grays: list[np.ndarray]) -> None:
    reason = why_not_usable()
    if reason:
        pytest.skip(f"COLMAP's PatchMatch cannot run: {reason}")
    raw = colmap_patch_match(grays, rig.cameras, rig.depth_range, SETTINGS)
    filtered = filter_depths(grays, rig.cameras, *map(list, zip(*raw)), SETTINGS)
    found = score([result.depth for result in filtered], rig.truths, rig.covisible)
    assert found.completeness > 0.25
    assert found.wrong < 0.05


def test_without_cuda_one_sentence_says_what_to_do(
    rig: Rig, grays: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap_mvs, "why_not_usable", lambda: "the installed pycolmap was built without CUDA")
    with pytest.raises(D2Error, match="built without CUDA: install pycolmap-cuda12 .* or set matcher = patchmatch"):
        MATCHERS["colmap"](grays, rig.cameras, rig.depth_range, SETTINGS, None)


def test_has_cuda_alone_does_not_make_colmap_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(colmap_mvs, "_has_cuda_device", lambda: False)
    assert why_not_usable() == "there is no CUDA device"
    monkeypatch.setattr(colmap_mvs, "_has_cuda_device", lambda: True)
    assert why_not_usable() == ""
    assert choose_matcher("auto") == "colmap"
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    assert "without CUDA" in why_not_usable()
    assert choose_matcher("auto") != "colmap"
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert why_not_usable() == "pycolmap is not installed"

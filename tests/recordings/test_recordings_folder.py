"""The folder layout: what is read, what is refused and in which words."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from stand_in_recordings import refused

from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import write_png
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording


@pytest.fixture(scope="module")
def original() -> Recording:
    return synthetic_recording(cameras=2, held_out=1, frames=2, width=32, height=24)


@pytest.fixture(scope="module")
def saved(original: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_recording(original, tmp_path_factory.mktemp("recordings") / "scene")


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """A copy of the saved recording that a test may spoil."""
    return Path(shutil.copytree(saved, tmp_path / "scene"))


def edit_calibration(folder: Path, camera: int | None, **changes: object) -> None:
    path = folder / "cameras.json"
    content = json.loads(path.read_text())
    (content if camera is None else content["cameras"][camera]).update(changes)
    path.write_text(json.dumps(content))


def test_a_saved_recording_reads_back_bitwise_and_is_not_written_over(original: Recording, saved: Path) -> None:
    refuses("not empty.*nothing was written", save_recording, original, saved)
    found = open_recording(saved)
    assert (found.name, found.frames, found.fps) == ("scene", original.frames, original.fps)
    assert found.mono_kind == "relative"
    assert found.mono_emulated
    for name, camera in original.cameras.items():
        again = found.cameras[name]
        np.testing.assert_array_equal(again.K, camera.K)
        np.testing.assert_array_equal(again.T_camera_world, camera.T_camera_world)
        assert (again.width, again.height, again.near_far) == (camera.width, camera.height, camera.near_far)
        for frame in original.frames:
            np.testing.assert_array_equal(found.image(name, frame), original.image(name, frame))
            np.testing.assert_array_equal(found.depth(name, frame), original.depth(name, frame))
            np.testing.assert_array_equal(found.mono(name, frame), original.mono(name, frame))


def test_opening_reads_headers_only(folder: Path) -> None:
    for image in (folder / "images").rglob("*.png"):
        image.write_bytes(image.read_bytes()[:40])
    refuses(r"00000\.png is not a readable PNG or JPEG", open_recording(folder).image, "train0", 0)


def test_maps_are_declared_in_mono_json_and_optional(folder: Path) -> None:
    (folder / "mono" / "mono.json").write_text('{"kind": "metric"}')
    recording = open_recording(folder)
    assert recording.mono_kind == "metric"
    assert not recording.mono_emulated
    (folder / "mono" / "mono.json").write_text('{"kind": "disparity"}')
    refused(folder, r"unknown kind of .*mono\.json 'disparity': have metric, relative")
    shutil.rmtree(folder / "depth")
    shutil.rmtree(folder / "mono")
    recording = open_recording(folder)
    assert recording.mono_kind is None
    assert recording.depth("train0", 0) is None
    assert recording.mono("train0", 0) is None


def test_maps_that_are_no_arrays_are_not_silently_left_out(folder: Path) -> None:
    assert not any("mono/" in note for note in open_recording(folder).notes)
    for array in sorted((folder / "mono").glob("*/*.npy")):
        array.rename(array.with_suffix(".png"))
    recording = open_recording(folder)
    assert recording.mono_kind is None
    assert (
        "nothing in mono/ is used: a map is an array of numbers [height, width] in mono/CAMERA/FRAME.npy"
        in recording.notes
    )
    shutil.rmtree(folder / "mono")
    assert not any("mono/" in note for note in open_recording(folder).notes)


def test_depth_that_is_not_finite_counts_as_unknown_and_monocular_maps_keep_their_holes(folder, original) -> None:
    depth = original.depth("train0", 0).copy()
    depth[0, :3] = np.nan, np.inf, -1
    np.savez(folder / "depth" / "train0" / "00000.npz", depth=depth)
    read = open_recording(folder).depth("train0", 0)
    np.testing.assert_array_equal(read[0, :3], 0)
    np.testing.assert_array_equal(read[1:], depth[1:])
    np.save(folder / "mono" / "train0" / "00000.npy", np.full((5, 7), np.nan, np.float16))
    mono = open_recording(folder).mono("train0", 0)
    assert mono.shape == (5, 7)
    assert mono.dtype == np.float32
    assert np.isnan(mono).all()


def test_frames_that_not_every_camera_has_are_left_out_and_noted(folder: Path) -> None:
    (folder / "images" / "train1" / "00001.png").unlink()
    recording = open_recording(folder)
    assert recording.frames == (0,)
    assert any("1 frame left out" in note for note in recording.notes)
    chosen = open_recording(folder, cameras=["test0", "train0"], frames=[1])
    assert (list(chosen.cameras), chosen.frames) == (["test0", "train0"], (1,))


def test_missing_things_are_refused_in_one_sentence(folder: Path, tmp_path: Path) -> None:
    refused(tmp_path / "nowhere", "no such recording")
    refused(tmp_path, "is no recording: expected cameras.json")
    refused(folder, "unknown camera 'train7'.*did you mean 'train", cameras=["train7"])
    refused(folder, "frame 9 is not in scene", frames=[0, 9])
    refused(folder, "unknown layout 'folders'.*did you mean 'folder'", layout="folders")
    refused(folder, "empty or repeated", cameras=["train0", "train0"])
    shutil.rmtree(folder / "images")
    refused(folder, "is no recording, as it has no images: expected cameras.json")


def test_images_that_fit_no_camera_or_frame_are_refused(folder: Path) -> None:
    images = folder / "images" / "train0"
    shutil.copy(images / "00001.png", images / "1.png")
    refused(folder, r"00001\.png and 1\.png .* are both frame 1")
    (images / "1.png").rename(images / "cover.png")
    refused(folder, "no frame number")
    (images / "cover.png").rename(images / "0.042.png")
    refused(folder, r"0\.042\.png is named by a time: name the frames 00000\.png, 00001\.png")
    (images / "0.042.png").unlink()
    shutil.copytree(images, folder / "images" / "extra")
    refused(folder, r"camera extra has images but is not in .*cameras\.json, which has train0, train1, test0")
    assert any("extra" in note for note in open_recording(folder, intersect=True).notes)
    shutil.rmtree(folder / "images" / "extra")
    edit_calibration(folder, 1, width=64)
    refused(folder, r"is 32x24 pixels but cameras\.json says 64x24 for camera train1")
    for image in (folder / "images").rglob("*.png"):
        image.unlink()
    refused(folder, "camera train0, train1, test0 of .* has no image")


def test_images_of_two_sizes_are_refused_when_read(folder: Path) -> None:
    write_png(folder / "images" / "train0" / "00001.png", np.zeros((12, 16, 3), np.uint8))
    recording = open_recording(folder)
    refuses("frame 1 of camera train0 is 16x12 pixels but its calibration says 32x24", recording.image, "train0", 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": float("nan")}, "cameras.json as JSON .*NaN, which is not finite"),
        ({"fy": -3.0}, "focal lengths"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, r"camera train0 .* an R that is no rotation \(orthonormal rows"),
        ({"R": [[1.01, 0, 0], [0, 1.01, 0], [0, 0, 1.01]]}, "no rotation"),
        ({"R": [[1, 0], [0, 1]]}, "cannot be understood"),
        ({"width": 0}, "at least one pixel"),
        ({"k1": 0.1}, r"has distortion as k1, k2 and others: write .*opencv.*\[k1, k2, p1, p2, k3\]"),
        ({"name": "train1"}, "camera train1 twice"),
    ],
)
def test_calibrations_that_cannot_be_are_refused(folder: Path, changes: dict, message: str) -> None:
    edit_calibration(folder, 0, **changes)
    refused(folder, message)


def test_cameras_late_by_more_than_a_thousand_units_are_read_back(original: Recording, tmp_path: Path) -> None:
    late = {"train0": {0: 0.0, 1: 4200.0}}  # a clock in milliseconds
    assert open_recording(save_recording(replace(original, late=late), tmp_path / "late")).late == late


@pytest.mark.parametrize("table", ["bounds", "exposures", "late"])
def test_tables_of_cameras_that_are_not_there_are_named(folder: Path, table: str) -> None:
    description = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps({**description, table: {"camera 7": {}}}))
    assert f"{table} of camera 7 in cameras.json are of no camera there" in open_recording(folder).notes


def test_broken_descriptions_are_refused(folder: Path) -> None:
    edit_calibration(folder, None, bounds={"train0": [3.0, 1.0]})
    refused(folder, "depth bounds 3 to 1")
    edit_calibration(folder, None, bounds={}, fps=0)
    refused(folder, "fps 0, expected frames per second above 0")
    path = folder / "cameras.json"
    path.write_text(path.read_text().replace('"cx"', '"x"', 1))
    refused(folder, "camera train0 .* has no cx")
    path.write_text("{")
    refused(folder, re.escape(str(path)) + " as JSON")

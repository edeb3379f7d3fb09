"""transforms.json: NeRF axes, times, intrinsics beside each image, splits, transparent images."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from stand_in_recordings import refused, write_grey

from d2_plugin.recordings import open_recording
from d2_plugin.recordings.images import read_image

W, H = 32, 24


def entry(name: str, x: float = 0.0, **more: object) -> dict:
    """An image of a camera at (x, 0, 0) that looks along -z of the world, as Blender's do."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    return {"file_path": name, "transform_matrix": matrix.tolist()} | more


def write(path: Path, frames: list[dict], file: str = "transforms.json", **top: object) -> Path:
    for i, frame in enumerate(frames):
        write_grey(path / f"{frame['file_path']}.png", i)
    (path / file).write_text(json.dumps({"camera_angle_x": 1.0, **top, "frames": frames}))
    return path


def two_by_two(**more: object) -> list[dict]:
    return [entry(f"images/cam{c:02d}_{f:04d}", x=c, time=f / 30, **more) for c in (0, 7) for f in (0, 1)]


def test_the_angle_of_view_is_the_focal_length(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path, two_by_two()))
    K = recording.cameras["cam00"].K
    assert 2 * math.atan(W / 2 / K[0, 0]) == pytest.approx(1.0)
    assert (K[0, 0], K[0, 2], K[1, 2]) == (K[1, 1], W / 2, H / 2)
    assert (recording.frames, recording.fps) == ((0, 1), pytest.approx(30))


def test_intrinsics_beside_a_image_win_and_scale_with_it(tmp_path: Path) -> None:
    frames = two_by_two()
    for frame in frames[:2]:
        frame.update(fl_x=100.0, fl_y=110.0, cx=33.0, cy=20.0, w=2 * W, h=2 * H)
    recording = open_recording(write(tmp_path, frames))
    np.testing.assert_allclose(recording.cameras["cam00"].K, [[50, 0, 16.5], [0, 55, 10], [0, 0, 1]])
    assert recording.cameras["cam07"].K[0, 0] == pytest.approx(W / 2 / math.tan(0.5))


def test_distortion_beside_a_image_is_undone(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    recording = open_recording(write(tmp_path, two_by_two(fl_x=30.0, k1=0.3)))
    assert any("distortion of cam00, cam07 is undone" in note for note in recording.notes)
    assert (recording.image("cam07", 1)[0, 0] == 0).all()
    fisheye = two_by_two(fl_x=30.0, camera_model="OPENCV_FISHEYE")
    assert any("undone" in note for note in open_recording(write(tmp_path, fisheye)).notes)
    refused(write(tmp_path, two_by_two(fl_x=30.0, k4=0.1)), "6 distortion coefficients")


def test_instant_ngp_says_fisheye_by_a_flag(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    lens = {"fl_x": 30.0, "k1": 0.05, "k2": 0.01, "k3": 0.01, "k4": 0.01}
    images = [
        open_recording(write(tmp_path / name, two_by_two(**lens), **{name: value})).image("cam00", 1)
        for name, value in (("is_fisheye", True), ("camera_model", "OPENCV_FISHEYE"))
    ]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "ORTHOPHOTO", "VR180_L", "FISHEYE624"])
def test_a_camera_that_is_no_pinhole_behind_a_lens_is_refused(model: str, tmp_path: Path) -> None:
    refused(write(tmp_path, two_by_two(), camera_model=model), f"camera_model '{model}', which is none of PINHOLE")


def test_frames_are_counted_by_time_where_names_do_not_run_with_it(tmp_path: Path) -> None:
    # Two splits, each numbered from 0: the same numbers mean other times.
    write(tmp_path, [entry(f"train/a_{i}", time=t) for i, t in enumerate((0.0, 0.5))], "transforms_train.json")
    write(tmp_path, [entry(f"test/b_{i}", x=1, time=t) for i, t in enumerate((0.5, 1.0))], "transforms_test.json")
    recording = open_recording(tmp_path)
    assert list(recording.cameras) == ["test", "train"]
    assert recording.frames == (1,)  # time 0.5 is the only one that both cameras have
    assert recording.fps == 2
    assert (recording.image("train", 1) == 1).all()
    assert (recording.image("test", 1) == 0).all()


def test_uneven_times_stay_those_of_the_file(tmp_path: Path) -> None:
    times = (3.0, 3.1, 3.2, 4.0)
    write(tmp_path, [entry(f"images/cam{c}_{f:04d}", x=c, time=t) for c in (0, 7) for f, t in enumerate(times)])
    recording = open_recording(tmp_path)
    for camera in recording.cameras:
        assert [recording.seconds(f, camera) for f in recording.frames] == pytest.approx([0, 0.1, 0.2, 1])
    assert not open_recording(write(tmp_path / "even", two_by_two())).late


def test_folders_of_splits_are_no_cameras(tmp_path: Path) -> None:
    names = ("train/cam01", "train/cam02", "test/cam00")
    frames = [entry(f"{name}_{f:04d}", x=i, time=f / 30) for i, name in enumerate(names) for f in range(2)]
    recording = open_recording(write(tmp_path, frames))
    assert list(recording.cameras) == ["cam00", "cam01", "cam02"]
    assert recording.frames == (0, 1)
    assert recording.cameras["cam00"].centre[0] == 2


def test_a_static_scene_is_one_instant_with_a_camera_per_image(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path, [entry(f"./train/r_{i}", x=i) for i in range(3)]))
    assert list(recording.cameras) == ["r_0", "r_1", "r_2"]
    assert recording.frames == (0,)
    assert (recording.image("r_2", 0) == 2).all()


def test_a_camera_that_moves_over_time_is_refused(tmp_path: Path) -> None:
    frames = [entry(f"./train/r_{i:03d}", x=i, time=i / 2) for i in range(3)]
    refused(write(tmp_path, frames), "3 images .* at 3 times by cameras that move")


def test_a_transparent_image_is_laid_over_black(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    rgba = np.zeros((2, 2, 4), np.uint8)
    rgba[..., :3], rgba[..., 3] = (10, 100, 200), [[255, 128], [0, 51]]  # blue, green, red, opacity
    cv2.imwrite(str(tmp_path / "a.png"), rgba)
    expected = [[[200, 100, 10], [100, 50, 5]], [[0, 0, 0], [40, 20, 2]]]
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), expected)
    cv2.imwrite(str(tmp_path / "b.png"), rgba.astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(tmp_path / "b.png"), expected)
    pillow = pytest.importorskip("PIL.Image")
    pillow.fromarray(np.array([[[100, 255], [100, 51]]], np.uint8)).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png")[0, :, 0], [100, 20])
    pillow.fromarray(rgba[..., :3]).save(tmp_path / "one.png", transparency=(10, 100, 200))
    assert not read_image(tmp_path / "one.png").any()


def test_missing_images_are_named_and_left_out_only_when_asked(tmp_path: Path) -> None:
    write(tmp_path, two_by_two())
    (tmp_path / "images" / "cam07_0001.png").unlink()
    refused(tmp_path, r"cam07_0001\.png is listed in .*transforms\.json but is not there \(1 of 4")
    recording = open_recording(tmp_path, intersect=True)
    assert recording.frames == (0,)
    assert any("1 listed image left out" in note for note in recording.notes)
    refused(tmp_path, "unknown camera 'cam1'", cameras=["cam1"], intersect=True)


def test_files_that_cannot_be_are_refused(tmp_path: Path) -> None:
    write(tmp_path, [])
    refused(tmp_path, "that lists images")
    (tmp_path / "transforms.json").write_text('{"camera_angle_x": 1}')
    refused(tmp_path, "has no frames: write one entry per image")
    refused(write(tmp_path, [entry("a_0", time=None)]), "time of an image in .* must be a number, got None")
    refused(write(tmp_path, [entry("a_0", transform_matrix=[[1, 0], [0, 1]])]), "cannot be understood")
    refused(write(tmp_path, [entry("a_0", time=0.0), entry("a_1")]), "some images .* have a time")
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [entry("a_0")]}))
    refused(tmp_path, "neither fl_x nor camera_angle_x")

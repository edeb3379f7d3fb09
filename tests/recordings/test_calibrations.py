"""Calibrations of other tools: what was written from known cameras comes back, distortion included."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")
import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)

pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")

from calibration_writers import CASES, Known, anipose, easymocap, in_first_camera, panoptic, pose2sim, rig, transforms
from refusals import refuses

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import CalibratedCamera, scaled
from d2_plugin.recordings.cameras.formats.cameras_json import camera_table
from d2_plugin.recordings.files import arrange

POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
"""In front of every camera of `rig`."""


def cameras_of(path: Path, sizes: dict[str, tuple[int, int]] | None = None) -> tuple[CalibratedCamera, ...]:
    return open_calibration(path, sizes).cameras


def assert_same(found: CalibratedCamera, known: Known, points: np.ndarray) -> None:
    R, t = found.T_camera_world[:3, :3], found.T_camera_world[:3, 3]
    assert found.size == known.size
    np.testing.assert_allclose(R, known.R, atol=1e-6)
    np.testing.assert_allclose(t, known.t, atol=1e-6)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(found.lens.K - half, known.K, atol=1e-6)
    seen = (points @ R.T + t) @ found.pinhole().K.T
    recorded = found.lens.recorded_pixels(seen[:, :2] / seen[:, 2:])
    expected = known.project(points) + 0.5
    assert np.ptp(expected, axis=0).min() > 200, "the points cover too little of the image to say anything"
    np.testing.assert_allclose(recorded, expected, atol=0.01)


@pytest.mark.parametrize("name", CASES)
def test_known_cameras_come_back(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    cameras = rig(case.coefficients, case.fisheye, case.names)
    written = case.write(tmp_path, cameras)
    sizes = None if case.sizes else {camera.name: camera.size for camera in cameras}
    found = open_calibration(written, sizes)
    assert found.format == case.format
    assert not found.notes
    assert [camera.name for camera in found.cameras] == [camera.name for camera in cameras]
    points = POINTS
    if case.relative:
        points = POINTS @ cameras[0].R.T + cameras[0].t
        cameras = in_first_camera(cameras)
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"cameras": [camera_table(camera) for camera in found.cameras]}))
    for camera, again, known in zip(found.cameras, cameras_of(own), cameras, strict=True):
        assert_same(camera, known, points)
        assert_same(again, known, points)  # our own JSON says everything
    named = case.format in ("easymocap", "colmap") or "stereo" in name
    if not named:  # the format is seen from the content
        assert open_calibration(written.rename(tmp_path / "rig.txt"), sizes).format == case.format


def test_a_folder_with_one_calibration_is_enough(tmp_path: Path) -> None:
    pose2sim(tmp_path, rig(4))
    (tmp_path / "notes.json").write_text('{"hello": 1}')
    assert open_calibration(tmp_path).format == "pose2sim"
    anipose(tmp_path, rig())
    refuses(r"holds 2 calibrations \(Calib_board.toml, calibration.toml\), expected one", open_calibration, tmp_path)


def test_recordings_of_another_size_scale_the_intrinsics(tmp_path: Path) -> None:
    cameras = rig()
    path = anipose(tmp_path, cameras)
    (found,) = cameras_of(path, {"cam_1": (640, 360)})
    assert found.size == (640, 360)
    seen = (POINTS @ found.T_camera_world[:3, :3].T + found.T_camera_world[:3, 3]) @ found.pinhole().K.T
    half_size = found.lens.recorded_pixels(seen[:, :2] / seen[:, 2:])
    np.testing.assert_allclose(half_size, (cameras[1].project(POINTS) + 0.5) / 2, atol=0.01)
    refuses("cam_1 are 720x1280 .* another aspect: .* turned .EXIF is not", cameras_of, path, {"cam_1": (720, 1280)})


@pytest.mark.parametrize(
    ("per_metre", "unit"),
    [(1000, "millimetres (scale .001)"), (100, "centimetres (scale .01) or, of a small rig, millimetres (scale .001)")],
)
def test_units_that_are_no_metres_are_noted_with_the_scale_that_mends_them(per_metre, unit, tmp_path) -> None:
    calibration = open_calibration(anipose(tmp_path, [camera._replace(t=per_metre * camera.t) for camera in rig()]))
    (note,) = calibration.notes
    assert f"looks like {unit} instead of metres" in note
    for camera, known in zip(scaled(calibration.cameras, 1 / per_metre), rig(), strict=True):
        assert_same(camera, known, POINTS)
        assert camera.near_far is None
        (bounded,) = scaled([replace(camera, near_far=(500.0, 9000.0))], 0.001)
        assert bounded.near_far == pytest.approx((0.5, 9.0))  # else no camera would see what another one sees


def test_names_that_only_some_files_have(tmp_path: Path) -> None:
    """Caliscope's numbers have gaps, and Multical's poses are called after a master camera where one was chosen."""
    path = CASES["caliscope"].write(tmp_path, rig())
    path.write_text(path.read_text().replace("cam_id = 1", "cam_id = 3\nrotation_count = -1\ngrid_count = 25"))
    assert [camera.name for camera in cameras_of(path)] == ["cam_0", "cam_3", "cam_2"]
    path = CASES["multical"].write(tmp_path, rig())
    table = json.loads(path.read_text())
    table["camera_poses"] = {f"{name}_to_cam_0": pose for name, pose in table["camera_poses"].items()}
    path.write_text(json.dumps(table))
    for camera, known in zip(cameras_of(path), rig(), strict=True):
        assert_same(camera, known, POINTS)


def kalibr_with(old: str, new: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        written = CASES["kalibr"].write(path, rig(4, names=("cam0", "cam1")))
        written.write_text(written.read_text().replace(old, new))
        return written

    return write


def file_with(name: str, content: bytes) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        (path / name).write_bytes(content)
        return path / name

    return write


UNPLACED = b"[cameras.0]\ncam_id = 0\nsize = [4, 4]\nmatrix = [[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]\n"
PLACED = UNPLACED + b"rotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n"
TRANSPOSED = b'{"frames": [{"file_path": "a", "transform_matrix": [1,0,0,0, 0,1,0,0, 0,0,1,0, 7,8,9,1]}]}'
NO_UNDISTORTION = "cam0 .* model {}, .*pinhole-equi or pinhole-radtan"


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (file_with("cam.pickle", b"\x80\x04\x95."), "is a pickle, which can run any program .* convert it to TOML"),
        (file_with("notes.txt", b"four cameras"), "txt, which looks like no XML, JSON or YAML, as TOML"),
        (file_with("a.json", b'{"frames": 3}'), "no calibration that can be read: expected one of folder, caliscope"),
        (lambda path: path / "b.json", "no such calibration"),
        (file_with("a.yaml", b"a: &a [1]\ncam0: *a\n"), "has YAML aliases"),
        (file_with("a.toml", UNPLACED), "cam_0 .* has no rotation and no translation: Caliscope could not place it"),
        (file_with("a.toml", PLACED.replace(b"0, 1]", b"0, 2]")), "camera cam_0 .* has a K that is not fx skew cx, 0"),
        (file_with("a.json", TRANSPOSED), r"ends with the row \[7.0, 8.0, 9.0, 1.0\], expected 0 0 0 1"),
        (kalibr_with("pinhole", "omni"), NO_UNDISTORTION.format("omni")),
        (kalibr_with("radtan", "fov"), NO_UNDISTORTION.format("fov")),
    ],
)
def test_what_is_no_calibration_is_refused_in_one_sentence(write, message, tmp_path) -> None:
    refuses(message, cameras_of, write(tmp_path))


def test_sizes_that_nobody_names_and_recordings_that_are_not_described(tmp_path: Path) -> None:
    easymocap(tmp_path, rig(names=("00", "01")))
    text = (tmp_path / "intri.yml").read_text()
    (tmp_path / "intri.yml").write_text("\n".join(line for line in text.splitlines() if line[:2] not in ("W_", "H_")))
    refuses("names no size of the images of camera 00: give the recordings with it", cameras_of, tmp_path)
    assert cameras_of(tmp_path, {"00": (1080, 1920)})[0].height == 1920
    path = anipose(tmp_path, rig())
    refuses("no camera for cam_7, only cam_0, cam_1, cam_2", cameras_of, path, {"cam_7": (1280, 720)})


class TestDamaged:
    """What 2,000 mutations of each format found."""

    def test_a_camera_without_its_label_is_named_by_its_images(self, tmp_path: Path) -> None:
        path = transforms(tmp_path, rig())
        content = json.loads(path.read_text())
        del content["frames"][1]["camera_label"]
        path.write_text(json.dumps(content))
        assert sorted(camera.name for camera in cameras_of(path)) == ["cam_0", "cam_1", "cam_2"]

    @pytest.mark.parametrize("name", ["", "."])
    def test_a_image_without_a_name(self, name: str, tmp_path: Path) -> None:
        (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
        (tmp_path / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")
        with pytest.raises(D2Error):
            cameras_of(tmp_path)
        refuses("every image needs the name of its file", arrange, [name], lambda group: True)


class TestNames:
    """Recordings find their cameras; a way that fits only some is not taken."""

    @pytest.mark.parametrize(
        ("expected", "recordings"),
        [
            (("cam_2", "cam_0", "cam_1"), ("cam_2", "cam_0", "cam_1")),
            (("00_07", "00_05", "00_06"), ("hd_00_07", "hd_00_05", "hd_00_06")),
            (("int_cam10_img", "int_cam1_img", "int_cam2_img"), ("cam10", "cam01", "cam02")),
            (("right", "left", "top"), ("GOPRO-Right", "GOPRO-Left", "GOPRO-Top")),
        ],
    )
    def test_by_name(self, expected: tuple[str, ...], recordings: tuple[str, ...], tmp_path: Path) -> None:
        cameras = sorted(expected)
        path = panoptic(tmp_path, [camera._replace(size=(1280, 720)) for camera in rig(names=cameras)])
        found = open_calibration(path, dict.fromkeys(recordings, (1280, 720)))
        assert [camera.name for camera in found.cameras] == list(recordings)
        of_file = {camera.name: cameras[round(camera.lens.K[0, 0]) - 900] for camera in found.cameras}
        assert of_file == dict(zip(recordings, expected, strict=True))
        assert not found.notes

    def test_by_order_with_a_note(self, tmp_path: Path) -> None:
        path = anipose(tmp_path, [camera._replace(size=(1280, 720)) for camera in rig()])
        found = open_calibration(path, dict.fromkeys(("kitchen", "attic", "cellar"), (1280, 720)))
        assert [round(camera.lens.K[0, 0]) for camera in found.cameras] == [902, 900, 901]
        (note,) = found.notes
        assert "attic is cam_0, cellar is cam_1, kitchen is cam_2" in note

    def test_two_cameras_of_one_number_are_not_guessed(self, tmp_path: Path) -> None:
        path = panoptic(tmp_path, rig(names=("00_01", "01_01", "02_05")))
        refuses("has no camera for cam1, cam5", cameras_of, path, {"cam1": (1280, 720), "cam5": (1280, 720)})

"""ENeRF-Outdoor's layout: OpenCV's YAML, cameras that not every file knows, distortion undone on load."""

from pathlib import Path

import numpy as np
import pytest
from stand_in_recordings import refused, write_grey

from d2_plugin.recordings import open_recording
from d2_plugin.recordings.cameras.rotations import rotation_of_vector

cv2 = pytest.importorskip("cv2")
for module in ("yaml", "scipy"):
    pytest.importorskip(module)

from calibration_writers import Known, easymocap  # noqa: E402  where its packages are

W, H = 48, 32
R_11 = (1.631797, -1.236095, 0.801056)
T_11 = (0.327633, 1.096058, 3.260243)


def scene(path: Path, folders: tuple[str, ...] = ("00", "11"), k1: float = 0.0) -> Path:
    """intri.yml knows 00 to 03 and 11, extri.yml 00 and 11; images show 10 * camera + frame."""
    K, R = np.array([[40.1, 0, 25.06], [0, 40.3, 13.3], [0, 0, 1]]), cv2.Rodrigues(np.array(R_11))[0]
    cameras = [Known(name, (W, H), K, (k1, 0, 0, 0, 0), R, np.array(T_11)) for name in ("00", "01", "02", "03", "11")]
    path.mkdir(parents=True, exist_ok=True)
    intrinsics = (easymocap(path, cameras) / "intri.yml").read_bytes()
    (easymocap(path, [cameras[0], cameras[-1]]) / "intri.yml").write_bytes(intrinsics)
    for folder in folders:
        for frame in range(3):
            write_grey(path / "images" / folder / f"{frame:06d}.png", 10 * int(folder) + frame, (W, H))
    return path


def test_cameras_are_those_with_intrinsics_pose_and_images(tmp_path: Path) -> None:
    path = scene(tmp_path, folders=("00", "11", "02", "17"))
    (path / "vhull").mkdir()
    (path / "background.ply").touch()
    recording = open_recording(path)
    assert recording.layout == "enerf"
    assert list(recording.cameras) == ["00", "11"]
    [note] = [note for note in recording.notes if "left out" in note]
    assert note == "left out, calibration missing: 02, 17"
    assert "not used: vhull, background.ply" in recording.notes
    assert (recording.frames, recording.fps) == ((0, 1, 2), 60)
    assert (recording.image("11", 2) == 112).all()
    refused(path, r"camera 02 has images but is not in .*extri\.yml, which has 00, 11", cameras=["02"])


def test_near_and_far_stand_beside_the_pose_where_a_camera_has_them(tmp_path: Path) -> None:
    path = scene(tmp_path)
    with (path / "extri.yml").open("a") as file:
        file.write("n_11: 3.5\nf_11: 9\n")
    cameras = open_recording(path).cameras
    assert (cameras["11"].near_far, cameras["00"].near_far) == ((3.5, 9.0), None)


def test_a_rotation_vector_may_be_zero_or_tiny() -> None:
    np.testing.assert_array_equal(rotation_of_vector(np.zeros(3)), np.eye(3))
    tiny = rotation_of_vector(np.array([0, 0, 1e-9]))
    np.testing.assert_allclose(tiny, [[1, -1e-9, 0], [1e-9, 1, 0], [0, 0, 1]], atol=1e-17)


def test_the_matrix_serves_where_the_vector_is_missing(tmp_path: Path) -> None:
    path = scene(tmp_path)
    without_vector = (path / "extri.yml").read_text().replace("\nR_", "\nunused_")
    expected = open_recording(path).cameras["11"].T_camera_world
    (path / "extri.yml").write_text(without_vector)
    np.testing.assert_allclose(open_recording(path).cameras["11"].T_camera_world, expected, atol=2e-6)
    (path / "extri.yml").write_text(without_vector.replace("Rot_", "also_unused_"))
    refused(path, "neither R_00 nor Rot_00")


@pytest.mark.parametrize("key", ["dist", "D"])
def test_distortion_is_undone_under_either_name(tmp_path: Path, key: str) -> None:
    path = scene(tmp_path, k1=0.4)
    (path / "intri.yml").write_text((path / "intri.yml").read_text().replace("dist_", f"{key}_"))
    recording = open_recording(path)
    assert any("distortion of 00, 11 is undone" in note for note in recording.notes)
    assert (recording.image("11", 0)[-1, 0] == 0).all()
    assert not any("undone" in note for note in open_recording(scene(tmp_path)).notes)


def test_the_folders_name_the_cameras_where_no_list_does(tmp_path: Path) -> None:
    path = scene(tmp_path)
    for file in (path / "intri.yml", path / "extri.yml"):
        header, _, entries = file.read_text().partition("names:")
        file.write_text(header + entries[entries.index("K_" if file.name == "intri.yml" else "R_") :])
    assert list(open_recording(path).cameras) == ["00", "11"]


def test_files_that_cannot_be_are_refused(tmp_path: Path) -> None:
    path = scene(tmp_path)
    whole = (path / "extri.yml").read_text()
    (path / "extri.yml").write_text(whole.replace("T_11: !!opencv-matrix", "T_11: hello\nother: !!opencv-matrix"))
    refused(path, "T_11 in .* is no matrix")
    (path / "extri.yml").write_text(whole.replace("rows: 3\n   cols: 1", "rows: 1\n   cols: 3"))
    assert list(open_recording(path).cameras) == ["00", "11"]  # a row serves as well as a column

"""The Technicolor layout: both releases, off-centre principal points, known damage, what is refused."""

from pathlib import Path

import numpy as np
import pytest
from stand_in_recordings import refused, write_grey

from d2_plugin.recordings import open_recording

W, H = 32, 16
HEADER = "f cu cv ar sk qw qx qy qz tx ty tz\n"
INTRINSICS = "30.5 17.25 6.5 1.02 0"
POSE = "0.6 0 0.8 0 0.1 -0.2 0.3"


def rig(path: Path, cameras: int = 3, frames: tuple[int, ...] = (151, 152), **options: str) -> Path:
    """A recording of several cameras whose images show 10 * camera + number of the frame in order."""
    scene, tag = options.get("scene", "Birthday"), options.get("tag", "_undist")
    line = options.get("line", f"{INTRINSICS} {POSE}")
    path.mkdir(parents=True, exist_ok=True)
    (path / "cameras_parameters.txt").write_text(HEADER + f"{line}\n" * cameras + "\n")
    for camera in range(cameras):
        for i, frame in enumerate(frames):
            write_grey(path / f"{scene}{tag}_{frame:05d}_{camera:02d}.png", 10 * camera + i, (W, H))
    return path


def test_a_line_is_a_camera_and_the_last_two_numbers_of_a_name_are_frame_and_camera(tmp_path: Path) -> None:
    recording = open_recording(rig(tmp_path / "Birthday"))
    assert recording.layout == "technicolor"
    assert list(recording.cameras) == ["00", "01", "02"]
    assert (recording.frames, recording.fps) == ((151, 152), 30)
    assert (recording.image("02", 152) == 21).all()
    camera = recording.cameras["01"]
    np.testing.assert_allclose(camera.K, [[30.5, 0, 17.25], [0, 1.02 * 30.5, 6.5], [0, 0, 1]], atol=1e-12)
    # A quaternion (.6, 0, .8, 0) turns by 2 atan(.8 / .6) about y; the pose maps world to camera.
    cosine, sine = 0.6**2 - 0.8**2, 2 * 0.6 * 0.8
    rotation = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    np.testing.assert_allclose(camera.T_camera_world[:3, :3], rotation, atol=1e-12)
    np.testing.assert_array_equal(camera.T_camera_world[:3, 3], [0.1, -0.2, 0.3])
    assert camera.near_far == (1.75, 10.0)


def test_the_distorted_release_is_undistorted_on_load(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    path = rig(tmp_path / "Train", scene="Train", tag="", line=f"{INTRINSICS} 0.4 0.05 {POSE}")
    for file in path.glob("*.png"):
        write_grey(file, 200, (W, H))
    recording = open_recording(path)
    np.testing.assert_array_equal(recording.cameras["00"].T_camera_world[:3, 3], [0.1, -0.2, 0.3])
    assert any("distortion of 00, 01, 02 is undone" in note for note in recording.notes)
    assert (recording.image("00", 151)[0, 0] == 0).all()
    already = open_recording(rig(tmp_path / "again", scene="Train", line=f"{INTRINSICS} 0.4 0.05 {POSE}"))
    assert (already.image("01", 151) == 10).all()
    assert not any("undone" in note for note in already.notes)


def test_known_damaged_images_are_replaced_and_named(tmp_path: Path) -> None:
    recording = open_recording(rig(tmp_path / "any_name", cameras=10, frames=(172, 173, 174)))
    assert (recording.image("09", 173) == 90).all()  # frame 172's
    assert (recording.image("08", 173) == 81).all()
    assert any("frame 173 of camera 09 is known to be damaged: frame 172 stands in" in n for n in recording.notes)
    alone = open_recording(rig(tmp_path / "without", cameras=10, frames=(173, 174)))
    assert alone.frames == (174,)
    assert any("damaged and left out" in note for note in alone.notes)
    assert not open_recording(rig(tmp_path / "other", cameras=10, frames=(172, 173), scene="Painter")).notes


def test_files_that_cannot_be_are_refused(tmp_path: Path) -> None:
    refused(rig(tmp_path / "b", line=f"{INTRINSICS} 0.1 {POSE}"), "line 2 of .* has 13 numbers, expected 12 .* or 14")
    refused(rig(tmp_path / "b", line=f"{INTRINSICS} 0 0 0 0 0 0 0"), "length zero")
    path = rig(tmp_path / "a", frames=())
    refused(path, "no images in .*: expected names like Birthday_undist")
    rig(path)
    write_grey(path / "Birthday_00151_00.png", size=(W, H))
    refused(path, "are both frame 151 of camera 00")
    (path / "Birthday_00151_00.png").unlink()
    write_grey(path / "Train_undist_00151_00.png", size=(W, H))
    refused(path, "several scenes .birthday, train.")
    (path / "cameras_parameters.txt").write_text(HEADER)
    refused(path, "describes no camera")

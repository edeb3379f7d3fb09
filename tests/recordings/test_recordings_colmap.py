"""COLMAP models, binary and text: cameras by name, lenses undone, what is refused and in which words."""

import zlib  # noqa: F401  before pycolmap, see d2_plugin.priors.colmap.points
from pathlib import Path

import numpy as np
import pytest
from small_layouts import write_layout
from stand_in_recordings import refused, write_grey

from d2_plugin.recordings import open_recording
from d2_plugin.recordings.cameras.formats.colmap import MODELS, find_model, read_model, read_points

W, H = 32, 24
PINHOLE = "1 PINHOLE 32 24 30 31 15.5 12.25"


def write_text(folder: Path, cameras: list[str], images: list[str], observations: str = "") -> None:
    """A text model: lines of cameras.txt, and of images.txt without the second line of each image."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("# Camera list\n" + "\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("# Image list\n" + "".join(f"{image}\n{observations}\n" for image in images))


def pose_line(identity: int, name: str, x: float = 0.0) -> str:
    return f"{identity} 1 0 0 0 {x} 0 0 1 {name}"


def two_cameras(path: Path, pattern: str = "{}_{:04d}.png") -> Path:
    """Two cameras with three frames each, of which only the first is registered (4C4D's way)."""
    names = ["cam01", "cam10"]
    lines = [pose_line(i + 1, pattern.format(name, 0), x=i) for i, name in enumerate(names)]
    write_text(path / "sparse" / "0", [PINHOLE], lines)
    for i, name in enumerate(names):
        for frame in range(3):
            write_grey(path / "images" / pattern.format(name, frame), 100 * i + frame)
    return path


@pytest.mark.parametrize("binary", [True, False])
def test_models_that_colmap_itself_writes_are_read_and_undistorted_as_it_does(tmp_path: Path, binary: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model, rng, poses = pycolmap.Reconstruction(), np.random.default_rng(1), {}
    for i, (name, count) in enumerate(MODELS[:6] + MODELS[8:10], start=1):
        shape = [30.0, 31.0, 15.0, 12.0] if name == "PINHOLE" or "OPENCV" in name else [30.0, 15.0, 12.0]
        parameters = (shape + [0.05, -0.02, 0.003, 0.004])[:count]
        camera = pycolmap.Camera(model=name, width=W, height=H, camera_id=i, params=parameters)
        model.add_camera_with_trivial_rig(camera)
        quaternion = rng.normal(size=4)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), rng.normal(size=3))
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"cam{i}/0001.png", camera_id=i, image_id=i), pose)
        poses[i] = pose.matrix()
        write_grey(tmp_path / "images" / f"cam{i}" / "0001.png")
    points = rng.normal(size=(4, 3))
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.array([1, 2, 3], np.uint8))
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(folder))

    found, rays = read_model(folder), rng.uniform(-0.4, 0.4, (20, 2))
    for i, pose in poses.items():
        np.testing.assert_allclose(found.images[i].T_camera_world[:3], pose, atol=1e-12)
        lens = found.cameras[i].lens("model")
        ours = lens.recorded_pixels(rays * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2])
        theirs = model.cameras[i].img_from_cam(np.concatenate([rays, np.ones((20, 1))], axis=1))
        np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=found.cameras[i].model)
    sparse = read_points(folder)
    np.testing.assert_allclose(np.sort(sparse.positions, axis=0), np.sort(points, axis=0), atol=1e-12)
    np.testing.assert_array_equal(sparse.colors, np.tile([1, 2, 3], (4, 1)))
    recording = open_recording(tmp_path)
    assert list(recording.cameras) == [f"cam{i}" for i in poses]
    assert recording.frames == (1,)
    assert any("distortion of cam3, cam4, cam5, cam6, cam7, cam8 is undone" in note for note in recording.notes)


@pytest.mark.parametrize("pattern", ["{}_{:04d}.png", "{}/{:04d}.png", "{}/images/frame_{:04d}.png"])
def test_one_registered_frame_gives_its_pose_to_the_frames_on_disk(tmp_path: Path, pattern: str) -> None:
    two_cameras(tmp_path, pattern)
    if (inside := tmp_path / "images" / "cam10").is_dir():
        inside.rename(tmp_path / "elsewhere")
        inside.symlink_to(tmp_path / "elsewhere")
    recording = open_recording(tmp_path)
    assert list(recording.cameras) == ["cam01", "cam10"]
    assert recording.frames == (0, 1, 2)
    assert recording.cameras["cam10"].T_camera_world[0, 3] == 1
    np.testing.assert_array_equal(recording.cameras["cam01"].K[:2, 2], [15.5, 12.25])
    assert (recording.image("cam10", 2) == 102).all()


def test_the_second_line_of_an_image_may_hold_observations(tmp_path: Path) -> None:
    lines = [pose_line(1, "a_0.png"), pose_line(2, "b_0.png", x=1.0)]
    write_text(tmp_path / "m", [PINHOLE], lines, "1.5 2.5 -1 3.5 4.5 7")
    assert [image.name for image in read_model(tmp_path / "m").images.values()] == ["a_0.png", "b_0.png"]


def test_a_still_scene_from_a_moving_camera_is_one_instant(tmp_path: Path) -> None:
    lines = [pose_line(i, f"DSC_{i:04d}.png", x=0.3 * i) for i in range(1, 4)]
    write_text(tmp_path / "sparse" / "0", [PINHOLE], lines)
    for i in range(1, 6):
        write_grey(tmp_path / "images" / f"DSC_{i:04d}.png", i)
    recording = open_recording(tmp_path)
    assert list(recording.cameras) == ["DSC_0001", "DSC_0002", "DSC_0003"]
    assert recording.frames == (0,)
    assert (recording.image("DSC_0003", 0) == 3).all()
    assert any("camera of its own at one instant" in note for note in recording.notes)
    assert any("2 images left out" in note for note in recording.notes)


def test_images_smaller_than_the_model_scale_its_intrinsics(tmp_path: Path) -> None:
    two_cameras(tmp_path)
    for file in (tmp_path / "images").iterdir():
        write_grey(file, size=(16, 12))
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording.cameras["cam01"].K, [[15, 0, 7.75], [0, 15.5, 6.125], [0, 0, 1]])
    for file in (tmp_path / "images").iterdir():
        write_grey(file, size=(16, 16))
    refused(tmp_path, "cam01 are 16x16 but .* says 32x24, another aspect")


def test_models_without_undistortion_are_refused(tmp_path: Path) -> None:
    two_cameras(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("1 FOV 32 24 30 31 15.5 12.25 0.9\n")
    refused(tmp_path, "model FOV with 5 parameters, which cannot be undistorted here: run `colmap image_undistorter`")


def test_damaged_models_are_refused_by_file(tmp_path: Path) -> None:
    path = write_layout("colmap", tmp_path / "scene")
    model = path / "sparse" / "0"
    whole = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(whole[:-3])
    refused(path, r"cannot read .*images\.bin as a COLMAP model")
    (model / "images.bin").write_bytes(bytes(8))
    refused(path, "registers no image")
    (model / "images.bin").write_bytes(whole)
    (model / "cameras.bin").write_bytes(bytes(8))
    refused(path, r"uses camera 1, which .*cameras\.bin lacks")
    (model / "images.bin").unlink()
    assert find_model(path) is None
    refused(path, "holds no COLMAP model", layout="colmap")

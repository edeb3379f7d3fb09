"""The N3DV layout: rows of poses_bounds.npy, videos and extracted frames."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from stand_in_recordings import smooth_recording, write_grey, write_videos

from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.importing.video import VideoFrames, read_video
from d2_plugin.recordings.readers.n3dv import camera_from_row

ROW = np.array(
    [-.0287202, .9990870, -.0316285, .0323124, 2028, .9944864, .0253668, -.1017517, -1.3285572, 2704,
     -.1008565, -.0343765, -.9943069, -.2155790, 1462.0671309, 8.5598926, 19.8132412]
)  # fmt: skip
"""The real row of camera cam00 of sear_steak."""


def test_a_real_row_becomes_the_opencv_camera_it_describes() -> None:
    camera = camera_from_row(ROW, "cam00", (1352, 1014), "poses_bounds.npy").pinhole("poses_bounds.npy")
    R = [[0.9990870, 0.0253668, -0.0343765], [-0.0287202, 0.9944864, -0.1008565], [0.0316285, 0.1017517, 0.9943069]]
    np.testing.assert_allclose(camera.T_camera_world[:3, :3], R, atol=1e-6)
    np.testing.assert_allclose(camera.T_camera_world[:3, 3], [-0.0059926, 1.3004175, 0.3485126], atol=1e-6)
    np.testing.assert_allclose(camera.centre, [0.0323124, -1.3285572, -0.2155790], atol=1e-6)
    assert camera.K[0, 0] == pytest.approx(731.0335654, abs=1e-6)
    assert camera.K[1, 1] == camera.K[0, 0]
    np.testing.assert_array_equal(camera.K[:2, 2], [676, 507])
    assert camera.near_far == (8.5598926, 19.8132412)


@pytest.mark.parametrize("pattern", ["cam{:02d}/images/", "cam{:02d}/", "images/cam{:02d}/", "images/cam{:02d}_"])
def test_extracted_frames_are_found_in_every_usual_place(tmp_path: Path, pattern: str) -> None:
    rows = np.stack([ROW, ROW])
    rows[1, 3] += 1
    np.save(tmp_path / "poses_bounds.npy", rows)
    for i, camera in enumerate((2, 13)):  # numbers may be missing: rows belong to the sorted names
        for frame in range(2):
            write_grey(tmp_path / (pattern + "{:04d}.png").format(camera, frame), 100 * i + frame, (8, 6))
    recording = open_recording(tmp_path)
    assert list(recording.cameras) == ["cam02", "cam13"]
    assert recording.frames == (0, 1)
    assert any("30 taken" in note for note in recording.notes)
    assert recording.fps == 30
    assert recording.cameras["cam13"].centre[0] == pytest.approx(ROW[3] + 1)
    assert (recording.image("cam13", 1) == 101).all()


def test_rows_and_cameras_must_agree_in_number(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.stack([ROW, ROW]))
    refuses(r"no cam\*\.mp4 and no extracted frames", open_recording, tmp_path)
    write_grey(tmp_path / "cam00" / "0000.png", size=(8, 6))
    np.save(tmp_path / "poses_bounds.npy", ROW)
    refuses(r"expected \[cameras, 17\]", open_recording, tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.where(np.arange(17) == 0, np.nan, ROW)[None])
    refuses("cam00.*not finite", open_recording, tmp_path)


def n3dv_scene(folder: Path, rows: int, cameras: tuple[int, ...]) -> Path:
    """Rows whose camera stands at x = row number, and one frame of each camera."""
    table = np.stack([ROW] * rows)
    table[:, 3] = np.arange(rows)
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "poses_bounds.npy", table)
    for camera in cameras:
        write_grey(folder / f"cam{camera:02d}" / "0000.png", size=(8, 6))
    return folder


def test_of_the_whole_rig_a_few_cameras_are_enough_when_asked(tmp_path: Path) -> None:
    path = n3dv_scene(tmp_path / "scene", 21, (0, 13, 20))
    refuses("21 rows for 3 cameras", open_recording, path)
    recording = open_recording(path, intersect=True)
    places = {name: camera.centre[0] for name, camera in recording.cameras.items()}
    assert places == pytest.approx({"cam00": 0, "cam13": 13, "cam20": 20}, abs=1e-6)
    assert any("18 of 21 cameras are not there" in note for note in recording.notes)
    lacking = n3dv_scene(tmp_path / "lacking", 18, (0, 13, 17))  # a scene without some: row 13 may be cam15's
    refuses("18 rows for 3 cameras", open_recording, lacking, intersect=True)


def test_the_unsynchronised_camera_of_coffee_martini_is_named(tmp_path: Path) -> None:
    assert any("cam13" in note for note in open_recording(n3dv_scene(tmp_path / "coffee_martini", 2, (0, 13))).notes)


def test_a_recording_has_the_same_cameras_and_images_in_both_layouts(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = write_videos(recorded := smooth_recording(("00", "05")), save_recording(recorded, tmp_path / "scene"))
    folder = open_recording(path)
    videos = open_recording(path, layout="n3dv")
    assert list(videos.cameras) == [f"cam{name}" for name in folder.cameras]
    assert (videos.frames, videos.fps) == (folder.frames, folder.fps)
    shown = videos.image("cam05", 7).astype(float)
    off = [np.abs(folder.image("05", frame) - shown).mean() for frame in folder.frames]
    assert off[7] < 3, "the images differ by the video's compression only"
    assert int(np.argmin(off)) == 7


def test_a_video_source_travels_to_another_process_and_ends_where_its_video_does(tmp_path: Path) -> None:
    pytest.importorskip("av")
    video = write_videos(smooth_recording(("00",), frames=6), tmp_path) / "cam00.mp4"
    source = VideoFrames({"a": read_video(video)})
    first = source.image("a", 4)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).image("a", 4), first)
    refuses(r"frame 400 of .*cam00\.mp4 cannot be decoded", source.image, "a", 400)


def test_checked_points_of_sear_steak_project_where_every_camera_sees_them(shared_data, tmp_path: Path) -> None:
    path = shared_data("n3dv_sear_steak_t0")
    shutil.copytree(path, tmp_path / "copy", ignore=shutil.ignore_patterns("cameras.json"))
    recording = open_recording(tmp_path / "copy")  # without cameras.json the rows are the calibration
    points = np.load(path / "sift_points.npz")["xyz"].astype(float)
    inside = np.zeros(len(points), int)
    for camera in recording.cameras.values():
        z = points @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
        homogeneous = (points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]) @ camera.K.T
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
        inside += (z > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    assert (inside >= 2).all()  # each was triangulated from at least two of the images

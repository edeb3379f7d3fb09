"""Fewer cameras, frames and pixels; images in and out of files; and the rendered room that all of it is tried on."""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prior_cases import world_points
from refusals import refuses

from benchmarks.priors_motion import scene_flow
from d2_plugin.errors import MissingExtra
from d2_plugin.priors.geometry import projected
from d2_plugin.recordings import Recording, open_recording, select_cameras, select_frames
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import image_size, read_image, shrink_depth, shrink_image, write_png
from d2_plugin.recordings.selection import downscale
from d2_plugin.recordings.synthetic.raycast import render_depth
from d2_plugin.recordings.synthetic.room import furnished_room, synthetic_recording

cv2 = pytest.importorskip("cv2")


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (37, 1), (23, 31)])
def test_a_written_png_reads_back_bitwise(tmp_path: Path, width: int, height: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    write_png(tmp_path / "image.png", image)
    assert image_size(tmp_path / "image.png") == (width, height)
    np.testing.assert_array_equal(read_image(tmp_path / "image.png"), image)


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]])
def test_the_size_of_a_jpeg_is_read_from_its_header(tmp_path: Path, options: list[int]) -> None:
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.zeros((21, 34, 3), np.uint8), options)
    assert image_size(path) == (34, 21)
    # A comment of 300 bytes and fill bytes in front of the frame header.
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xfe" + struct.pack(">H", 302) + bytes(300) + b"\xff\xff" + data[2:][1:])
    assert image_size(path) == (34, 21)


def test_a_image_rotated_by_its_metadata_keeps_the_stored_pixel_order(tmp_path: Path) -> None:
    path = tmp_path / "rotated.jpg"
    cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
    data = path.read_bytes()
    orientation = struct.pack("<HHHII", 1, 0x0112, 3, 1, 6)  # by 90 degrees
    body = b"Exif\x00\x00" + b"II*\x00\x08\x00\x00\x00" + orientation + bytes(4)
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
    assert read_image(path).shape == (20, 30, 3)


def test_a_photo_with_a_video_behind_it_is_whole_and_one_with_a_thumbnail_before_its_cut_is_not(tmp_path: Path) -> None:
    path, thumbnail = tmp_path / "photo.jpg", b"\xff\xd8\xff\xd9"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data + bytes(1 << 17))  # phones append what they filmed
    assert read_image(path).shape == (20, 30, 3)
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(thumbnail)) + thumbnail + data[2:-100])
    refuses("end marker is missing", read_image, path)


def test_only_images_need_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_recording(synthetic_recording(cameras=1, frames=1, width=16, height=16), tmp_path / "scene")
    monkeypatch.setitem(sys.modules, "cv2", None)
    refuses(r"images needs OpenCV.*d2-4dgs\[image\]", open_recording(path).image, "train0", 0, error=MissingExtra)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 5), st.integers(5, 23), st.integers(5, 23), st.integers(0, 2**31))
def test_downscaling_a_image_is_opencvs_area_mean(factor: int, height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    small = shrink_image(image, factor)
    whole = image[: height // factor * factor, : width // factor * factor]
    area = cv2.resize(whole, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    assert small.shape == area.shape
    assert np.abs(small.astype(int) - area).max() <= 1  # rounding of halves


def test_downscaled_depth_averages_one_surface_and_ignores_unknown_pixels() -> None:
    depth = np.array([[2.0, 2.02, 0, 0], [2.02, 2.04, 0, 3.0]], np.float32)
    np.testing.assert_allclose(shrink_depth(depth, 2), [[2.02, 3.0]], rtol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.integers(0, 2**31))
def test_downscaled_depth_stays_within_the_known_depths_of_its_block(factor: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = (rng.uniform(0.5, 50, (12, 12)) * (rng.random((12, 12)) < 0.6)).astype(np.float32)
    small = shrink_depth(depth, factor)
    for row, column in np.ndindex(small.shape):
        block = depth[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
        known = block[block > 0]
        if known.size:
            assert known.min() * 0.9999 <= small[row, column] <= known.max() * 1.0001
        else:
            assert small[row, column] == 0


def test_a_downscaled_recording_projects_points_to_the_same_place() -> None:
    recording = synthetic_recording(cameras=1, held_out=0, frames=1, width=50, height=38)
    small = downscale(recording, 4)
    camera, smaller = recording.cameras["train0"], small.cameras["train0"]
    assert (smaller.width, smaller.height) == (12, 9)
    point = np.array([0.2, -0.1, 3.0])
    large, little = camera.K @ point, smaller.K @ point
    np.testing.assert_allclose(little[:2] / little[2], large[:2] / large[2] / 4)  # corners at integers: no half pixel
    assert small.image("train0", 0).shape == (9, 12, 3)
    assert small.depth("train0", 0).shape == (9, 12)
    assert small.mono("train0", 0).shape == (38, 50)
    np.testing.assert_array_equal(small.image("train0", 0), shrink_image(recording.image("train0", 0), 4))
    assert downscale(recording, 1) is recording
    refuses("downscale must be at least 1", downscale, recording, 0)


def test_selections_are_checked() -> None:
    recording = synthetic_recording(frames=3, width=16, height=16)
    assert list(select_cameras(recording, ["test1", "train0"]).cameras) == ["test1", "train0"]
    assert select_frames(recording, [2, 0, 2]).frames == (0, 2)
    refuses("no camera chosen", select_cameras, recording, [])
    refuses("duplicate", select_cameras, recording, ["test0", "test0"])
    refuses("no frame chosen.*0 to 2", select_frames, recording, [])


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(frames=6, width=120, height=68)


def test_what_moves_is_seen_later_where_its_scene_flow_says(recording: Recording) -> None:
    """Points of a frame and their flow: never in front of the depth of a later frame, mostly on it; walls stand."""
    camera, flow = recording.cameras["train1"], scene_flow(recording.source, "train1", 0, 3).reshape(-1, 3)
    moves = np.linalg.norm(flow, axis=1) > 1e-6
    assert 0.01 < moves.mean() < 0.3
    pixels, depth, _ = projected(camera, (world_points(camera, recording.depth("train1", 0)) + flow)[moves])
    ratio = depth / recording.depth("train1", 3)[tuple(pixels.astype(int).T[::-1])]
    assert np.mean(np.abs(ratio - 1) < 0.02) > 0.7, "what turns away is not seen any more"
    assert np.mean(ratio < 0.97) < 0.1  # only at silhouettes, by up to a pixel
    np.testing.assert_allclose(scene_flow(recording.source, "train1", 2, 2), 0, atol=1e-6)


def test_depth_matches_the_sphere_it_is_told_to_be() -> None:
    """The ball's depth against its equation, per pixel of a camera that looks straight at it."""
    scene = furnished_room(seed=0, moving=True)
    ball = next(solid for solid in scene.solids if solid.radius is not None)
    recording = synthetic_recording(cameras=1, held_out=0, frames=1, width=120, height=68)
    camera = recording.cameras["train0"]
    depth = render_depth(scene, camera, 0.5).astype(float)
    distances = np.linalg.norm(world_points(camera, depth) - ball.motion(0.5)[1], axis=1)
    assert distances.min() > ball.radius * (1 - 1e-6)
    assert (distances < ball.radius * (1 + 1e-5)).sum() > 50


def test_the_same_arguments_give_the_same_recording(recording: Recording) -> None:
    again = synthetic_recording(frames=6, width=120, height=68)
    np.testing.assert_array_equal(again.image("test1", 3), recording.image("test1", 3))
    np.testing.assert_array_equal(again.mono("test1", 3), recording.mono("test1", 3))
    other = synthetic_recording(frames=6, width=120, height=68, seed=1)
    assert (other.image("test1", 3) != recording.image("test1", 3)).mean() > 0.2


def test_a_returned_image_is_the_callers_own(recording: Recording) -> None:
    before = recording.image("train0", 0).copy()
    recording.image("train0", 0)[:] = 0
    np.testing.assert_array_equal(recording.image("train0", 0), before)


@pytest.mark.parametrize("wrong", [{"cameras": 0}, {"frames": 0}, {"width": 4}, {"fps": 0.0}, {"held_out": -1}])
def test_impossible_recordings_are_refused(wrong: dict) -> None:
    refuses("is not possible", synthetic_recording, **wrong)

"""A recording goes out in the layout of each public repository and comes back with the same cameras and images."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from stand_in_recordings import smooth_recording

from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording, open_recording, select_cameras, select_frames
from d2_plugin.recordings.cameras.camera import pinhole
from d2_plugin.recordings.cameras.formats.colmap import read_model, read_points
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation, rotation_of_quaternion
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.export.n3dv import sorted_names
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.recordings.synthetic.room import synthetic_recording

CLOUD = PointCloud(
    np.random.default_rng(0).uniform(-1, 1, (40, 3)) + [0, 0, 0.5],
    np.random.default_rng(1).uniform(0, 1, (40, 3)),
    np.linspace(0, 0.1, 40),
)


@pytest.fixture(scope="module")
def original() -> Recording:
    return synthetic_recording(cameras=2, held_out=1, frames=2, width=32, height=24)


def names_of(folder: Path) -> dict[str, str]:
    return json.loads((folder / "export.json").read_text())["cameras"]


@pytest.mark.parametrize("layout", ["transforms", "n3dv", "colmap"])
def test_cameras_named_by_digits_in_any_order_read_back_the_same(layout: str, tmp_path: Path, caplog) -> None:
    whole = smooth_recording(("00", "01", "02", "03"), frames=6, width=32, height=24)
    chosen = select_cameras(select_frames(whole, (0, 5)), ("01", "00", "02"))
    chosen = replace(chosen, late={"02": {0: -0.01, 5: 0.008}})
    folder = export_recording(chosen, layout, tmp_path / layout, test_cameras=("01",), cloud=CLOUD)
    back, names = open_recording(folder), names_of(folder)
    for name, camera in chosen.cameras.items():
        found = back.cameras[names[name]]
        assert (found.width, found.height) == (camera.width, camera.height)
        np.testing.assert_allclose(found.K, camera.K, atol=1e-6)
        np.testing.assert_allclose(found.T_camera_world, camera.T_camera_world, atol=1e-6)
    np.testing.assert_array_equal(back.image(names["02"], 5), chosen.image("02", 5))
    if layout == "transforms":
        assert (back.late, back.frames, back.fps) == (chosen.late, chosen.frames, pytest.approx(chosen.fps))
        last = json.loads((folder / "transforms_train.json").read_text())["frames"][-1]["time"]
        assert last == pytest.approx(5 / chosen.fps + 0.018), "the first one is at 0"
    assert ("cannot say" in caplog.text) == (layout != "transforms")
    if layout == "n3dv":
        assert names == {"01": "cam00", "00": "cam01", "02": "cam02"}, "its readers hold out the first"
        assert {path.name for path in (folder / "frames").iterdir()} == set(names.values())
        assert (folder / "frames" / "cam00" / "cam00_0000.png").is_file()


def test_transforms_are_what_its_readers_expect(original: Recording, tmp_path: Path) -> None:
    """fudan's reader sets the field of view to -1 where it finds fl_x, and draws footprints too large (issue 64)."""
    held_out = list(original.cameras)[-1]
    folder = export_recording(original, "transforms", tmp_path / "scene", test_cameras=[held_out])
    train, test = (json.loads((folder / f"transforms_{split}.json").read_text()) for split in ("train", "test"))
    assert not {"fl_x", "cx"} & ({*train} | {*train["frames"][0]})
    camera = next(iter(original.cameras.values()))
    assert math.tan(train["camera_angle_x"] / 2) == pytest.approx(camera.width / 2 / camera.K[0, 0], rel=1e-12)
    matrix = np.array(train["frames"][0]["transform_matrix"])  # OpenGL looks along the negative z
    np.testing.assert_allclose(-matrix[:3, 2], camera.T_camera_world[2, :3], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], camera.centre, atol=1e-12)
    assert {Path(frame["file_path"]).name.rsplit("_", 1)[0] for frame in test["frames"]} == {held_out}
    assert len(train["frames"]) == 2 * len(original.frames)
    assert train["frames"][1]["time"] == pytest.approx(original.seconds(original.frames[1]))
    assert any(f"transforms_test.json lists {held_out}" in note for note in open_recording(folder).notes)


def test_a_colmap_model_is_of_one_instant_with_the_points_given(original: Recording, tmp_path: Path) -> None:
    """4C4D refuses a model that registers more than one image of a camera."""
    folder = export_recording(original, "colmap", tmp_path / "scene", cloud=CLOUD)
    model = folder / "sparse" / "0"
    registered = [image.name for image in read_model(model).images.values()]
    assert registered == [f"{name}_{original.frames[0]:04d}.png" for name in original.cameras]
    assert len(list((folder / "images").iterdir())) == len(original.cameras) * len(original.frames)
    points = read_points(model)
    np.testing.assert_allclose(points.positions, CLOUD.positions)
    np.testing.assert_allclose(points.colors / 255, CLOUD.colors, atol=0.5 / 255 + 1e-9)
    header, body = (model / "points3D.ply").read_bytes().split(b"end_header\n", 1)
    assert b"property uchar red" in header
    assert len(body) == 40 * 8 * 4  # x y z nx ny nz time as floats, four bytes of colour: a whole number of floats
    np.testing.assert_allclose(np.frombuffer(body[:12], "<f4"), CLOUD.positions[0], rtol=1e-6)


def test_a_hundred_cameras_still_sort_in_order() -> None:
    names = list(sorted_names([f"left{i}" for i in range(101)], 1).values())
    assert names == sorted(names)
    assert sorted_names(["01", "00"], 1) == {"01": "cam00", "00": "cam01"}
    assert sorted_names(["00", "01"], 1) == {"00": "cam00", "01": "cam01"}


def test_multipleview_has_the_names_that_4dgaussians_makes_up(original: Recording, tmp_path: Path) -> None:
    held_out = next(iter(original.cameras))
    folder = export_recording(original, "multipleview", tmp_path / "scene", test_cameras=[held_out], cloud=CLOUD)
    assert held_out not in names_of(folder)
    assert sorted(path.name for path in (folder / "cam01").iterdir()) == ["frame_00001.jpg", "frame_00002.jpg"]
    model = read_model(folder / "sparse_")
    assert [image.name[5:-4] for image in model.images.values()] == ["1", "2"]
    expected = original.cameras[list(original.cameras)[1]]
    np.testing.assert_allclose(model.images[1].T_camera_world, expected.T_camera_world, atol=1e-6)
    assert np.load(folder / "poses_bounds_multipleview.npy").shape == (2, 17)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_lose_nothing_at_any_angle(components: list[float]) -> None:
    rotation = rotation_of_quaternion(np.array(components))
    np.testing.assert_allclose(rotation_of_quaternion(quaternion_of_rotation(rotation)), rotation, atol=1e-12)


@pytest.mark.parametrize("layout", ["n3dv", "multipleview"])
def test_what_a_layout_cannot_hold_is_refused_by_camera(original: Recording, layout: str, tmp_path: Path) -> None:
    """Principal points off the centre and two focal lengths, as calibration really gives them."""
    K = pinhole(30, 31, 15.5, 12.25)
    uneven = replace(original, cameras={name: replace(camera, K=K) for name, camera in original.cameras.items()})
    with pytest.raises(D2Error, match="holds one focal length and the centre .* choose the layout transforms"):
        export_recording(uneven, layout, tmp_path / "scene", cloud=CLOUD)


def test_mistakes_are_one_sentence(original: Recording, tmp_path: Path) -> None:
    refuses("unknown layout 'blender': have colmap, ", export_recording, original, "blender", tmp_path / "a")
    with pytest.raises(D2Error, match="all cameras of .* are held out"):
        export_recording(original, "colmap", tmp_path / "a", test_cameras=list(original.cameras))
    refuses("multipleview needs initial points", export_recording, original, "multipleview", tmp_path / "b")
    (tmp_path / "file").touch()
    refuses("is not empty: choose another folder", export_recording, original, "colmap", tmp_path)


def test_a_link_in_the_place_of_an_unfinished_export_is_not_followed(original: Recording, tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.tex").write_text("mine")
    (tmp_path / ".out.part").symlink_to(tmp_path / "precious")
    with pytest.raises(D2Error, match=r"\.out\.part is a link, and an unfinished export is none: remove it"):
        export_recording(original, "transforms", tmp_path / "out")
    assert (tmp_path / "precious" / "thesis.tex").read_text() == "mine"


def test_the_command_writes_points_and_says_where(tmp_path: Path, answered, refused, monkeypatch) -> None:
    source = save_recording(smooth_recording(("00", "01", "02", "03"), frames=3), tmp_path / "source")
    command = f"export-recording {source} --format transforms --output {tmp_path / 'scene'} --train-cameras 00,02 "
    command += "--test-cameras 01 --frames 0:1 --downscale 4 --points 50"
    assert f"in {tmp_path / 'scene'} (transforms)" in answered(*command.split())
    monkeypatch.setattr("d2_plugin.commands.export_recording.start_cloud", None)  # refused before the points
    assert "is not empty: choose another" in refused(*command.split())
    one = f"{source} --format gsplat --output {tmp_path / 'one'} --points 0 --test-cameras 00"
    assert answered("export-recording", *one.split()).startswith("4 cameras, 1 frame, no initial points in")
    alone = f"{source} --format transforms --output {tmp_path / 'alone'} --points 0 --train-cameras 02 --frames 1"
    assert answered("export-recording", *alone.split()).startswith("1 camera, 1 frame, no initial points in")
    content = json.loads((tmp_path / "scene" / "export.json").read_text())
    assert (list(content["cameras"]), content["test_cameras"]) == (["00", "02", "01"], ["01"])
    assert int((tmp_path / "scene" / "points3d.ply").read_bytes().split(b"element vertex ")[1].split()[0]) >= 50
    sorted((source / "images" / "03").iterdir())[-1].unlink()
    fewer = f"{source} --format transforms --output {tmp_path / 'fewer'} --points 0"
    assert "note  1 frame left out: not every camera has them\n4 cameras, 2 frames" in answered(
        "export-recording", *fewer.split()
    )


class TestColmapFrames:
    """What the readers of SpacetimeGaussians and Ex4DGS open, file by file (their dataset_readers.py)."""

    def test_every_instant_is_a_model_and_only_the_held_out_camera_is_cam00(self, tmp_path: Path) -> None:
        recording = smooth_recording(("05", "07", "11"), frames=3, width=32, height=24)
        without = export_recording(recording, "colmap_frames", tmp_path / "none", cloud=CLOUD)
        assert list(names_of(without).values()) == ["cam01", "cam02", "cam03"]
        folder = export_recording(recording, "colmap_frames", tmp_path / "data", test_cameras=["07"], cloud=CLOUD)
        assert names_of(folder) == {"07": "cam00", "05": "cam01", "11": "cam02"}
        assert np.load(folder / "poses_bounds.npy").shape == (3, 17)
        for index in range(3):
            model = folder / f"colmap_{index}" / "sparse" / "0"
            registered = sorted(image.name for image in read_model(model).images.values())
            assert registered == ["cam00.png", "cam01.png", "cam02.png"]
            assert len(read_points(model).positions) == len(CLOUD.positions)
            linked = folder / f"colmap_{index}" / "images" / "cam01.png"
            assert linked.read_bytes() == (folder / "cam01" / f"{index}.png").read_bytes()

    def test_two_held_out_cameras_are_refused_since_one_would_be_trained_on(self, tmp_path: Path) -> None:
        recording = smooth_recording(("05", "07", "11"), frames=1, width=32, height=24)
        with pytest.raises(D2Error, match="hold out one camera, got 05, 07"):
            export_recording(recording, "colmap_frames", tmp_path / "d", test_cameras=["05", "07"], cloud=CLOUD)

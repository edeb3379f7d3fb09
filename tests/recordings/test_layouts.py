"""Layouts are one table: a recording in each reads back, a reader or a writer is a function or two and one row."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from small_layouts import CLOUD, small_recording, write_layout
from stand_in_recordings import refused, write_grey

from d2_plugin.recordings import LAYOUTS, Layout, Recording, open_recording
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.camera import CalibratedCamera, pinhole
from d2_plugin.recordings.cameras.formats.colmap import find_model, read_points
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.export.base import Export, Written
from d2_plugin.recordings.export.export import WRITERS, export_recording
from d2_plugin.recordings.files import numbered_files
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2", reason="opencv is in the `image` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")


def is_tiny(path: Path) -> bool:
    return (path / "focal.txt").is_file()


def open_tiny(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """One camera at the origin; focal.txt holds its focal length in pixels."""
    images = {"only": numbered_files(path)}
    frames = tuple(images["only"])
    width, height = image_size(images["only"][frames[0]])
    focal = float((path / "focal.txt").read_text())
    camera = CalibratedCamera("only", width, height, Lens(pinhole(focal, focal, width / 2, height / 2)), np.eye(4))
    return assembled(path, {"only": camera}, images, frames, 30.0, "focal.txt")


def write_tiny(export: Export) -> Written:
    [camera] = export.recording.cameras.values()
    export.write_images(lambda _, frame: export.folder / f"{frame}.png")
    (export.folder / "focal.txt").write_text(f"{camera.K[0, 0]:.17g}")
    return export.written({camera.name: "only"})


def test_a_reader_is_two_functions_and_a_row_and_an_export_one_function_and_a_row(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "focal.txt").write_text("20")
    for frame in (3, 4):
        write_grey(tmp_path / f"{frame}.png", frame, (8, 6))
    refuses("is no recording", open_recording, tmp_path)
    monkeypatch.setitem(LAYOUTS, "tiny", Layout(is_tiny, open_tiny))
    for layout in (None, "tiny"):
        recording = open_recording(tmp_path, layout=layout, frames=[4], downscale=2)
        assert (recording.layout, recording.frames) == ("tiny", (4,))
        assert recording.cameras["only"].K[0, 0] == 10
        assert (recording.image("only", 4) == 4).all()
    refuses(r"of another layout \(.*colmap, tiny; see", open_recording, tmp_path.parent)
    monkeypatch.setitem(WRITERS, "tiny", write_tiny)
    original = synthetic_recording(cameras=1, frames=2, width=16, height=12)
    back = open_recording(export_recording(original, "tiny", tmp_path / "out"))
    np.testing.assert_array_equal(back.cameras["only"].K, original.cameras["train0"].K)
    np.testing.assert_array_equal(back.image("only", 1), original.image("train0", 1))


def test_the_documentation_has_the_same_layouts_in_the_same_order() -> None:
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| [")]
    assert [row.split("[")[1].split("]")[0] for row in rows] == list(LAYOUTS)


def test_a_folder_of_several_layouts_is_read_as_the_first_of_them(tmp_path: Path) -> None:
    for name in ("poses_bounds.npy", "cameras_parameters.txt", "intri.yml", "transforms.json"):
        (tmp_path / name).touch()
    assert sum(layout.recognised(tmp_path) for layout in LAYOUTS.values()) == 4
    refuses(r"cannot read .*poses_bounds\.npy|no cam\*\.mp4", open_recording, tmp_path)


LENSES = ("technicolor", "enerf")
"""Layouts whose small recording is written with a distortion."""


@pytest.mark.parametrize("layout", ["folder", "n3dv", "transforms", "colmap", "colmap_text", *LENSES])
def test_a_recording_reads_back(layout: str, tmp_path: Path) -> None:
    written, path = small_recording(), write_layout(layout, tmp_path / "recording")
    for file in [*path.rglob("*.png")]:
        file.with_name(f"._{file.name}").touch()  # as macOS leaves them on foreign disks
    if (path / "images").is_dir():
        (path / "images" / ".thumbs").mkdir()
    read = open_recording(path)
    assert not any("left out" in note for note in read.notes)
    assert len(read.frames) == len(written.frames)
    for ours, theirs in zip(written.cameras.values(), read.cameras.values(), strict=True):
        np.testing.assert_allclose(theirs.K, ours.K, atol=1e-6)
        np.testing.assert_allclose(theirs.T_camera_world, ours.T_camera_world, atol=1e-6)
        assert (theirs.width, theirs.height) == (ours.width, ours.height)
        image, expected = read.image(theirs.name, read.frames[1]), written.image(ours.name, written.frames[1])
        assert np.abs(image.astype(int) - expected).mean() < (6 if layout in LENSES else 1e-9)
    if model := find_model(tmp_path / "recording"):
        np.testing.assert_allclose(read_points(model).positions, CLOUD.positions)


@pytest.mark.parametrize("layout", ["folder", "n3dv", "technicolor", "colmap", "enerf"])
def test_a_camera_without_images_is_named_and_left_out_only_when_asked(layout: str, tmp_path: Path) -> None:
    path = write_layout(layout, tmp_path / "recording")
    first, last = open_recording(path).cameras
    for file in list(path.rglob("*.png")):
        inside = file.relative_to(path)  # the number of pytest's own folder may be a camera's, too
        if inside.parts[0] not in ("depth", "mono") and (file.match(f"*_{last}.png") or last in str(inside)):
            file.unlink()
    if layout != "enerf":  # whose published files describe more cameras than there are
        refused(path, rf"camera {last} of .* has no image \(\.png, \.jpg, \.jpeg\)")
    recording = open_recording(path, intersect=True)
    assert list(recording.cameras) == list(open_recording(path, cameras=[first]).cameras) == [first]
    assert any("left out" in note and last in note for note in recording.notes)
    refused(path, f"camera {last} .* has no image", cameras=[last], intersect=True)
    refused(path, "unknown camera 'nobody'", cameras=["nobody"])

"""What holds for every layout alike, on the same small recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from small_layouts import small_recording, write_layout
from stand_in_recordings import refused

from d2_plugin.recordings import open_recording

pytest.importorskip("cv2", reason="opencv is in the `image` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")

LENSES = ("technicolor", "enerf")
"""Layouts whose small recording is written with a distortion."""
LAYOUTS = ("folder", "n3dv", "transforms", "colmap", "colmap_text", *LENSES)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_recording_reads_back(layout: str, tmp_path: Path) -> None:
    written, read = small_recording(), open_recording(write_layout(layout, tmp_path / "recording"))
    assert len(read.frames) == len(written.frames)
    for ours, theirs in zip(written.cameras.values(), read.cameras.values(), strict=True):
        np.testing.assert_allclose(theirs.K, ours.K, atol=1e-6)
        np.testing.assert_allclose(theirs.T_camera_world, ours.T_camera_world, atol=1e-6)
        assert (theirs.width, theirs.height) == (ours.width, ours.height)
        image, expected = read.image(theirs.name, read.frames[1]), written.image(ours.name, written.frames[1])
        assert np.abs(image.astype(int) - expected).mean() < (6 if layout in LENSES else 1e-9)


@pytest.mark.parametrize("layout", ["folder", "n3dv", "technicolor", "colmap", "enerf"])
def test_a_camera_without_images_is_named_and_left_out_only_when_asked(layout: str, tmp_path: Path) -> None:
    path = write_layout(layout, tmp_path / "recording")
    first, last = open_recording(path).cameras
    for file in [file for file in path.rglob("*.png") if file.match(f"*_{last}.png") or last in str(file)]:
        if file.relative_to(path).parts[0] not in ("depth", "mono"):
            file.unlink()
    if (path / "images" / last).is_dir():
        (path / "images" / last).rmdir()
    if layout != "enerf":  # whose published files describe more cameras than there are
        refused(path, f"camera {last} of .* has no image")
    recording = open_recording(path, intersect=True)
    assert list(recording.cameras) == list(open_recording(path, cameras=[first]).cameras) == [first]
    assert any("left out" in note and last in note for note in recording.notes)
    refused(path, f"camera {last} .* has no image", cameras=[last], intersect=True)
    refused(path, "unknown camera 'nobody'", cameras=["nobody"])


def test_a_model_without_a_folder_of_images_is_refused(tmp_path: Path) -> None:
    path = write_layout("colmap", tmp_path / "recording")
    shutil.rmtree(path / "images")
    refused(path, "is no folder", layout="colmap")

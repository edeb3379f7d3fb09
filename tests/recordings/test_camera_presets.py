"""Camera presets: nested, without the cameras that are known to be unsound, and explained in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from stand_in_recordings import five_cameras

from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.presets import RIGS, VIEWS, camera_preset, is_preset, resolve_cameras
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

NAMES = {
    "n3dv": tuple(f"cam{i:02d}" for i in range(21)),
    "technicolor": tuple(f"{i:02d}" for i in range(16)),
    "enerf": tuple(f"{i:02d}" for i in range(18)),
}


def recording_of(layout: str, names: tuple[str, ...] | None = None, name: str = "scene", frames: int = 1) -> Recording:
    model = synthetic_recording(cameras=2, frames=frames, width=16, height=12)
    [camera, *_] = model.cameras.values()
    cameras = {n: replace(camera, name=n) for n in names or NAMES[layout]}
    return replace(model, cameras=cameras, layout=layout, name=name)


@pytest.mark.parametrize("layout", list(RIGS))
def test_more_views_are_fewer_views_and_one_camera_more(layout: str) -> None:
    recording = recording_of(layout)
    before: set[str] = set()
    for views in VIEWS:
        split = camera_preset(recording, f"preset:{views}")
        assert len(split.train) == len(set(split.train)) == views
        assert before < set(split.train)
        assert set(split.train) | set(split.test) == set(NAMES[layout])
        assert not set(split.train) & set(split.test)
        before = set(split.train)


@pytest.mark.parametrize("layout", list(RIGS))
def test_what_dense_comparisons_test_with_is_never_trained_on(layout: str) -> None:
    rig = RIGS[layout]
    assert not {*rig.order, *rig.spare} & set(rig.held_out)
    assert {*rig.order, *rig.spare, *rig.held_out} <= set(NAMES[layout])
    assert set(rig.held_out) <= set(camera_preset(recording_of(layout), "preset:4").test)


@pytest.mark.parametrize(("layout", "title"), [("n3dv", "N3DV"), ("technicolor", "Technicolor"), ("enerf", "ENeRF")])
def test_the_documentation_has_the_same_lists(layout: str, title: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
    [line] = [line for line in page.splitlines() if line.startswith(f"| {title}")]
    two, three, four, spare = (cell.replace("+", " ").split() for cell in line.strip("|").split("|")[1:])
    rig = RIGS[layout]
    assert (tuple(two + three + four), tuple(spare)) == (rig.order, rig.spare)


def test_four_views_of_n3dv_are_those_of_4c4d() -> None:
    assert camera_preset(recording_of("n3dv"), "preset:4").train == ("cam01", "cam10", "cam13", "cam20")


def test_the_unsynchronised_camera_is_neither_trained_on_nor_scored() -> None:
    split = camera_preset(recording_of("n3dv", name="coffee_martini"), "preset:4")
    assert split.train == ("cam01", "cam10", "cam12", "cam20")
    assert "cam13" not in split.test
    assert any("cam13 known to be unsynchronised" in note for note in split.notes)
    assert any("cam13 missing or unsynchronised: the next in order" in note for note in split.notes)


def test_a_recording_of_five_cameras_has_a_preset(tmp_path: Path) -> None:
    recording = open_recording(five_cameras(tmp_path / "scene"))  # read as a folder, an N3DV scene by its names
    split = camera_preset(recording, "preset:4")
    assert (split.train, split.test) == (("cam03", "cam05", "cam08", "cam14"), ("cam00",))
    assert any("cam01, cam13, cam10, cam20 missing" in note for note in split.notes)


def test_a_data_set_can_be_named() -> None:
    recording = recording_of("folder", NAMES["technicolor"])
    assert camera_preset(recording, "preset:technicolor:2").train == ("00", "15")
    with pytest.raises(D2Error, match="none of the data sets with presets .*preset:n3dv:4"):
        camera_preset(recording, "preset:2")
    with pytest.raises(D2Error, match="unknown data set 'n3d'.*did you mean 'n3dv'"):
        camera_preset(recording, "preset:n3d:2")


@pytest.mark.parametrize("text", ["preset:5", "preset:", "preset:four", "preset:a:b:4", "cam01"])
def test_texts_that_are_no_preset_are_refused(text: str) -> None:
    with pytest.raises(D2Error, match="is no camera preset: expected preset:2"):
        camera_preset(recording_of("n3dv"), text)
    assert is_preset(text) == text.startswith("preset:")


def test_too_few_known_cameras_are_refused() -> None:
    with pytest.raises(
        D2Error, match=r"needs 3 of cam01, cam13.* and scene has cam00, cam01, cam02: name the training"
    ):
        camera_preset(recording_of("n3dv", ("cam00", "cam01", "cam02")), "preset:3")


def test_a_run_is_given_names_in_place_of_a_preset(tmp_path: Path) -> None:
    path = five_cameras(tmp_path / "scene")
    train, test, notes = resolve_cameras(path, ("preset:2",))
    assert (train, test) == (("cam03", "cam14"), ("cam00", "cam05", "cam08"))
    assert notes
    assert resolve_cameras(path, ("preset:2",), ("cam00",))[1] == ("cam00",)
    assert resolve_cameras("nowhere", ("a", "b")) == (("a", "b"), None, ())
    with pytest.raises(D2Error, match="mixes a preset with other names"):
        resolve_cameras(path, ("preset:2", "cam00"))

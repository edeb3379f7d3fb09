"""Cameras by the name of a preset or a published protocol: nested, sound, explained, and never made up."""

from dataclasses import replace
from pathlib import Path

import pytest
from refusals import refuses
from stand_in_recordings import smooth_recording

from d2_plugin.commands.cli import main
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.presets import PROTOCOLS, RIGS, VIEWS, camera_split, resolve_cameras
from d2_plugin.runs.report.run_folders import training_row

N3DV = tuple(f"cam{i:02d}" for i in range(21))


def rig(name: str = "sear_steak", cameras: tuple[str, ...] = N3DV, layout: str = "n3dv") -> Recording:
    return replace(smooth_recording(cameras, frames=1, width=32, height=24), name=name, layout=layout)


def test_more_views_are_fewer_views_and_one_camera_more() -> None:
    recording = rig("scene")
    before: set[str] = set()
    for views in VIEWS:
        split = camera_split(recording, f"preset:{views}")
        assert len(split.train) == len(set(split.train)) == views
        assert before < set(split.train)
        assert set(split.train) | set(split.test) == set(N3DV)
        assert not set(split.train) & set(split.test)
        before = set(split.train)
    one = RIGS["n3dv"]  # what dense comparisons test with is never trained on
    assert "cam00" not in {*one.order, *one.spare}
    assert "cam00" in split.test


def test_the_documentation_has_the_same_lists() -> None:
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
    [line] = [line for line in page.splitlines() if line.startswith("| N3DV")]
    two, three, four, spare = (cell.replace("+", " ").split() for cell in line.strip("|").split("|")[1:])
    assert (tuple(two + three + four), tuple(spare)) == (RIGS["n3dv"].order, RIGS["n3dv"].spare)


def test_the_unsynchronised_camera_is_neither_trained_on_nor_scored() -> None:
    split = camera_split(rig("coffee_martini"), "preset:4")
    assert split.train == ("cam01", "cam10", "cam12", "cam20")
    assert "cam13" not in split.test
    assert any("cam13 known to be unsynchronised" in note for note in split.notes)
    assert any("cam13 missing or unsynchronised: the next in order" in note for note in split.notes)


def test_a_recording_of_five_cameras_has_a_preset(tmp_path: Path) -> None:
    path = save_recording(rig(cameras=("cam00", "cam03", "cam05", "cam08", "cam14")), tmp_path / "scene")
    split = camera_split(open_recording(path), "preset:4")
    assert (split.train, split.test) == (("cam03", "cam05", "cam08", "cam14"), ("cam00",))
    assert any("cam01, cam13, cam10, cam20 missing" in note for note in split.notes)
    train, test, notes = resolve_cameras(path, ("preset:2",))
    assert (train, test) == (("cam03", "cam14"), ("cam00", "cam05", "cam08"))
    assert notes
    assert resolve_cameras(path, ("preset:2",), ("cam00",))[1] == ("cam00",)
    assert resolve_cameras("nowhere", ("a", "b")) == (("a", "b"), None, ())
    refuses("mixes a preset with other names", resolve_cameras, path, ("preset:2", "cam00"))


@pytest.mark.parametrize(
    ("name", "text", "train"),
    [
        ("scene", "preset:4", "cam01 cam10 cam13 cam20"),  # those of 4C4D
        ("scene", "preset:n3dv:2", "cam01 cam13"),
        ("sear_steak", "protocol:4c4d", "cam01 cam10 cam13 cam20"),
        ("sear_steak", "protocol:gc-4dgs-4", "cam04 cam09 cam12 cam17"),
        ("flame_salmon_1", "protocol:gc-4dgs-3", "cam05 cam09 cam14"),
        ("cut_roasted_beef", "protocol:gc-4dgs-2", "cam07 cam15"),  # lacks cam03: places are counted, not names
    ],
)
def test_lists_are_those_of_their_source(name: str, text: str, train: str) -> None:
    cameras = tuple(camera for camera in N3DV if (name, camera) != ("cut_roasted_beef", "cam03"))
    split = camera_split(rig(name, cameras), text)
    assert split.train == tuple(train.split())
    assert set(split.test) == ({"cam00"} if "gc-4dgs" in text else set(N3DV) - set(split.train))


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_says_its_source_and_never_trains_on_what_it_scores(name: str) -> None:
    split = camera_split(rig(), f"protocol:{name}")
    assert not set(split.train) & set(split.test)
    assert PROTOCOLS[name] in split.notes[0]


SIXTEEN = rig("scene", tuple(f"{i:02d}" for i in range(16)), "folder")
NO_PRESET = "is no camera preset: expected preset:2"


@pytest.mark.parametrize(
    ("recording", "text", "message"),
    [
        *((rig(), text, NO_PRESET) for text in ("preset:5", "preset:", "preset:four", "preset:a:b:4", "cam01")),
        (SIXTEEN, "preset:2", "none of the data sets with presets .*preset:n3dv:4"),
        (SIXTEEN, "preset:n3d:2", "unknown data set 'n3d'.*did you mean 'n3dv'"),
        (rig("scene", N3DV[:3]), "preset:3", "needs 3 of cam01, cam13.* and scene has cam00, cam01, cam02: name the"),
        (rig(), "protocol:d2-4dgs-4", "not public: choose preset:4, protocol:gc-4dgs-2"),
        (rig(cameras=N3DV[:5]), "protocol:gc-4dgs-4", "whole recording"),
        (rig(cameras=N3DV[:12]), "protocol:4c4d", "no cam13, cam20"),
        (rig("den"), "protocol:gc-4dgs-3", "not for 'den'"),
        (rig(), "protocol:gc-4dgs4", "did you mean"),
    ],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_what_fits_no_list_is_refused(recording: Recording, text: str, message: str) -> None:
    refuses(message, camera_split, recording, text)


def test_results_carry_the_protocols_name(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    path = save_recording(rig(), tmp_path / "sear_steak")
    command = ["train", str(path), "--train-cameras", "protocol:4c4d", "--test-cameras", "cam00", "--hooks", "none"]
    assert main([*command, "--iterations", "1", "--output", str(tmp_path / "run")]) == 0
    row = training_row(tmp_path / "run")
    assert row["protocol"] == "protocol:4c4d"
    assert row["case"] == "sear_steak, 4 views, protocol:4c4d"

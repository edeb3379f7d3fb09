"""A store is known by what its recording shows, and by its cameras: nobody else's priors are ever written over."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import contents

from d2_plugin.errors import D2Error
from d2_plugin.priors.build import PriorSettings, PriorSummary, build_priors
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

NAMES = ["train0", "train1", "train2"]
SETTINGS = PriorSettings(stereo=StereoSettings(matcher="patchmatch"))


def room(**changes: object) -> Recording:
    chosen = {"cameras": 3, "held_out": 0, "frames": 2, "width": 64, "height": 36, "arc_degrees": 20} | changes
    return synthetic_recording(**chosen)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return room()


def built(recording: Recording, folder: Path, names: list[str] = NAMES) -> PriorSummary:
    return build_priors(recording, names, folder, SETTINGS)


def moved(recording: Recording, name: str) -> Recording:
    camera = recording.cameras[name]
    pose = camera.T_camera_world.copy()
    pose[0, 3] += 0.01
    return replace(recording, cameras={**recording.cameras, name: replace(camera, T_camera_world=pose)})


@pytest.mark.parametrize("other", ["images", "a pose", "a size", "a rig"])
def test_another_recording_of_the_same_name_changes_no_byte(recording: Recording, tmp_path: Path, other: str) -> None:
    built(recording, tmp_path)
    before = contents(tmp_path)
    others = {
        "images": lambda: room(seed=5),
        "a pose": lambda: moved(recording, "train1"),
        "a size": lambda: room(width=48, height=27),
        "a rig": lambda: room(arc_degrees=30),
    }
    with pytest.raises(D2Error, match=r"holds the priors of \S+, not of .*\(.*\): choose another output folder"):
        built(others[other](), tmp_path)
    assert contents(tmp_path) == before


def test_a_new_name_and_another_order_of_the_cameras_change_no_file(recording: Recording, tmp_path: Path) -> None:
    built(recording, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    for same, names in ((recording, NAMES), (replace(recording, name="other"), NAMES), (recording, NAMES[::-1])):
        summary = built(same, tmp_path, names)
        assert (summary.built, summary.kept) == (0, 6)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("first", [NAMES, ["train0", "train2"]], ids=["fewer", "more"])
def test_other_cameras_of_the_recording_are_added_and_nothing_is_removed(
    recording: Recording, tmp_path: Path, first: list[str]
) -> None:
    second = ["train0", "train2"] if first == NAMES else NAMES
    built(recording, tmp_path / "store", first)
    before = contents(tmp_path / "store")
    summary = built(recording, tmp_path / "store", second)
    after = contents(tmp_path / "store")
    assert {name: after[name] for name in before} == before
    assert summary.folder == tmp_path / "store" / "cameras" / "+".join(second)
    assert PriorStore.open(tmp_path / "store").cameras == tuple(first)
    alone = built(recording, tmp_path / "alone", second)
    for name in second:  # what was built beside others is what is built alone
        ours, theirs = PriorStore.open(summary.folder).prior(name, 1), PriorStore.open(alone.folder).prior(name, 1)
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True) if a is not None)
    again = built(recording, tmp_path / "store", second)
    assert (again.built, again.kept) == (0, 2 * len(second))
    assert contents(tmp_path / "store") == after
    assert PriorStore.located(tmp_path / "store", second) == summary.folder
    assert PriorStore.located(tmp_path / "store", first) == tmp_path / "store"


def test_names_that_no_folder_can_have_get_one(tmp_path: Path) -> None:
    about = {"recording": "room"}
    PriorStore.create(tmp_path, ["a"], [0], about)
    for names in (["a", "b/../.."], [".", "a"], ["a", "b" * 90], ["a", "."]):
        store = PriorStore.create(tmp_path, names, [0], about)
        assert store.path.parent == tmp_path / "cameras"


def test_what_a_killed_build_left_is_removed_by_the_next(recording: Recording, tmp_path: Path) -> None:
    built(recording, tmp_path)
    left = tmp_path / "priors" / "train0" / ".0123456789abcdef.part"
    left.write_bytes(b"half a file")
    built(recording, tmp_path)
    assert not left.exists()


def test_a_header_that_lies_is_refused(recording: Recording, tmp_path: Path) -> None:
    built(recording, tmp_path)
    array = tmp_path / "priors" / "train0" / "00000.npy"
    whole = array.read_bytes()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("a", "b")
    lies = [
        whole.replace(b"(36, 64), }                ", b"(3600000000, 64000000), }"),
        whole.replace(b"'<u2'", b"'>u2'"),
        archive.getvalue(),
        whole.replace(b"{'descr'", b"{{{{{{{{"),
        b"",
    ]
    for content in lies:
        array.write_bytes(content)
        with pytest.raises(D2Error, match="camera train0, frame 0 is damaged"):
            PriorStore.open(tmp_path)

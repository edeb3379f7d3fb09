"""What people give by mistake: one sentence that says what to do, and nothing is written over."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import Filmed, Shooting, video, write_video
from stand_in_recordings import renamed

from d2_plugin.commands.cli import main
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("av")
pytest.importorskip("cv2")

NAMES = ("02", "03", "04")

Refused = Callable[..., str]


@pytest.fixture(scope="module")
def room() -> Recording:
    """Cameras that are rolled by different angles, so that no two can be taken for each other."""
    rendered = synthetic_recording(cameras=3, held_out=0, frames=10, width=240, height=136, arc_degrees=30.0)
    cameras = {}
    for (name, camera), roll in zip(rendered.cameras.items(), (-0.2, 0.0, 0.35)):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        cameras[name] = replace(camera, T_camera_world=turn @ camera.T_camera_world)
    return renamed(replace(rendered, cameras=cameras, source=replace(rendered.source, cameras=cameras)), NAMES)


@pytest.fixture(scope="module")
def filmed(room: Recording, tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    return video(room, tmp_path_factory.mktemp("good"), {name: Shooting() for name in NAMES}, sound=True)


@pytest.fixture
def given(filmed: Filmed, tmp_path: Path) -> Filmed:
    """A copy that a test may spoil."""
    shutil.copytree(filmed.folder, tmp_path / "given")
    return Filmed(tmp_path / "given", tmp_path / "given" / "cameras.json")


def importing(given: Filmed, output: Path, *more: str) -> list[str]:
    """The command that imports the videos without measuring exposures."""
    words = ["import", str(given.videos), "--calibration", str(given.calibration), "--output", str(output)]
    return [*words, "--exposure", "false", *more]


def change(given: Filmed, edit: Callable[[dict[str, Any]], object]) -> None:
    table = json.loads(given.calibration.read_text())
    edit({camera["name"]: camera for camera in table["cameras"]})
    given.calibration.write_text(json.dumps(table))


def no_frames(given: Filmed) -> None:
    write_video(given.videos / "03.mp4", [np.zeros((48, 64, 3), np.uint8)], [0.0])
    path = given.videos / "03.mp4"
    data = path.read_bytes()
    place = data.index(b"stsz")
    path.write_bytes(data[: place + 12] + b"\0\0\0\0" + data[place + 16 :])  # the table of samples holds none


def damaged(given: Filmed) -> None:
    path = given.videos / "03.mp4"
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start : start + (len(data) - start) * 3 // 4] = bytes((len(data) - start) * 3 // 4)
    path.write_bytes(data)


def cut_off(given: Filmed) -> None:
    path = given.videos / "03.mp4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def only_sound(given: Filmed) -> None:
    import av

    with av.open(str(given.videos / "03.mp4"), "w") as container:
        track = container.add_stream("aac", rate=48_000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48_000
        container.mux(track.encode(frame) + track.encode())


def swap(given: Filmed) -> None:
    one, other = given.videos / "02.mp4", given.videos / "04.mp4"
    one.rename(given.videos / "x.mp4")
    other.rename(one)
    (given.videos / "x.mp4").rename(other)


def edited(edit: Callable[[dict[str, Any]], object]) -> Callable[[Filmed], None]:
    """Spoils the calibration, whose entries `edit` takes by name."""
    return lambda given: change(given, edit)


def overwritten(name: str, content: bytes) -> Callable[[Filmed], object]:
    return lambda given: (given.folder / name).write_bytes(content)


def flipped(cameras: dict[str, Any]) -> None:
    """Poses as a tool with left-handed axes writes them."""
    for camera in cameras.values():
        camera.update(R=(np.array(camera["R"]) @ np.diag([1.0, 1.0, -1.0])).tolist())


def zoomed(cameras: dict[str, Any]) -> None:
    """A focal length that one camera did not have."""
    cameras["03"].update(fx=3 * cameras["03"]["fx"], fy=3 * cameras["03"]["fy"])


def called_alike(given: Filmed) -> None:
    shutil.copy(given.videos / "03.mp4", given.videos / "03.mov")


CASES: list[tuple[Callable[[Filmed], object], list[str], str]] = [
    (no_frames, [], r"has no frame|no frame of video"),
    (damaged, [], r"can(not)? be decoded.*(repair|replace) the"),
    (cut_off, [], r"cannot read video .*03\.mp4.*replace the file or leave camera 03 out"),
    (only_sound, [], r"03\.mp4 holds audio and no image: give a video"),
    (lambda given: [path.unlink() for path in given.videos.iterdir()], [], r"holds no video: give videos, or a folder"),
    (called_alike, [], r"are both called 03: name each video like its camera"),
    (swap, [], r"cameras 02 and 04 are swapped: exchange"),
    (edited(lambda c: c["03"].update(R=(np.diag([-1, 1, -1]) @ c["03"]["R"]).tolist())), ["--offsets", "none"], r"03"),
    (edited(zoomed), [], r"does not fit the videos: .*03.*; or give --accept-calibration"),
    (edited(flipped), [], r"camera 02 .*mirrored.*right-handed"),
    (
        edited(lambda c: [c[name].update(R=np.eye(3).tolist(), t=[0, 0, 0]) for name in NAMES]),
        [],
        r"puts all cameras at one place: give a calibration with their poses|does not fit",
    ),
    (edited(lambda c: c["03"].update(R=c["02"]["R"], t=c["02"]["t"])), [], r"cameras 02 and 03 the identical pose"),
    (overwritten("cameras.json", b"<?xml version='1.0'?><calibration/>"), [], r"\(qualisys\) describes no camera"),
    (overwritten("cameras.json", b"<!DOCTYPE a [<!ENTITY b 'c'>]><calibration/>"), [], r"declares entities"),
    (lambda given: None, ["--offsets", "07=3"], r"--offsets names camera '07', have 02, 03, 04"),
    (lambda given: None, ["--offsets", "03=soon"], r"--offsets says '03=soon', expected auto, .* or NAME=FRAMES"),
    (lambda given: None, ["--offsets", "timecode"], r"nothing in the timecode links"),
    (lambda given: None, ["--crop", "9000x10+0+0"], r"lies outside of camera 02, which has"),
    (lambda given: None, ["--crop", "all of it"], r"--crop says 'all of it', expected WIDTHxHEIGHT\+LEFT\+TOP"),
    (lambda given: None, ["--scale", "0.001"], r"--scale 0.001 of \d+x\d+ pixels leaves less than 8 of camera 02"),
    (lambda given: None, ["--crop", "4x9+0+0"], r"--scale 1 of 4x9 pixels leaves less than 8 .*: keep more of it"),
    (lambda given: None, ["--offsets", "3"], r"--offsets says '3', expected auto, .* or NAME=FRAMES such as 02="),
    (lambda given: (given.videos / "02.mp4").rename(given.videos / "z.mp4"), [], r"matched in the order .*; camera"),
]


@pytest.mark.parametrize(("spoil", "words", "says"), CASES, ids=lambda one: getattr(one, "__name__", None))
def test_one_sentence_and_nothing_written_over(given, tmp_path, refused, spoil, words, says) -> None:
    spoil(given)
    before = {path: path.read_bytes() for path in given.folder.rglob("*") if path.is_file()}
    sentence = refused(*importing(given, tmp_path / "recording", *words))
    assert re.search(says, sentence), sentence
    assert {path: path.read_bytes() for path in given.folder.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "recording" / "cameras.json").exists()


def test_another_import_and_another_folder_are_not_written_over(given: Filmed, tmp_path, refused: Refused) -> None:
    folder, small = tmp_path / "recording", ("--scale", "0.3", "--offsets", "none", "--frames")
    asked = refused(*importing(given, folder, *small, "500"))
    assert "--frames asks for 500 and the cameras have 0 to 9 in common: choose within" in asked
    assert main(importing(given, folder, *small, "0:4:2")) == 0, "what was refused leaves nothing in the way of advice"
    recording = open_recording(folder)
    assert recording.rate == pytest.approx(recording.fps / 2)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    said = refused(*importing(given, folder, *small, "0:2"))
    assert "holds another import, made with other frames: give another --output" in said
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    assert "is not empty and holds no import" in refused(*importing(given, tmp_path / "mine"))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_who_knows_better_imports_all_the_same(given: Filmed, tmp_path: Path) -> None:
    change(given, zoomed)
    words = importing(given, tmp_path / "c", "--offsets", "none", "--frames", "0:1", "--images", "videos")
    assert main([*words, "--accept-calibration"]) == 0
    assert any("misses features" in note for note in open_recording(tmp_path / "c").notes)


def test_one_video_of_another_event(room: Recording, tmp_path: Path, refused: Refused) -> None:
    """The same room, another take: sound of its own, and things that move at other times."""
    take = video(room, tmp_path / "one", {name: Shooting() for name in NAMES}, sound=True, sounds={"04": 99})
    said = refused(*importing(take, tmp_path / "c", "--offsets", "sound"))
    assert "nothing in the sound links 04 with 02, 03: leave camera 04 out, give the offsets" in said


def test_timecode_against_sound(room: Recording, tmp_path: Path, refused: Refused) -> None:
    shots = {name: Shooting(timecode="01:00:00:00") for name in NAMES}
    take = video(room, tmp_path / "one", {**shots, "04": Shooting(timecode="01:00:00:09")}, sound=True)
    assert "sound and timecode contradict each other" in refused(*importing(take, tmp_path / "c"))


def test_a_folder_of_videos_is_no_recording_yet(given: Filmed, refused: Refused, tmp_path: Path) -> None:
    for command, more in (("train", ["--output", str(tmp_path / "run")]), ("plan", [])):
        said = refused(command, str(given.videos), "--train-cameras", "all", *more)
        assert "holds videos and no calibration that goes with them: make a recording of them with `d2 import`" in said


def test_a_video_that_moved_since_it_was_imported(given: Filmed, tmp_path: Path, refused, monkeypatch) -> None:
    folder = tmp_path / "lazy"
    words = ("--offsets", "none", "--images", "videos", "--frames", "0:1")
    assert main(importing(given, folder, *words)) == 0
    (given.videos / "03.mp4").rename(tmp_path / "elsewhere.mp4")
    assert "the video of camera 03 is not at" in refused("plan", folder, "--train-cameras", "all")
    assert open_recording(folder, cameras=["02"]).image("02", 0).shape == (136, 240, 3)
    spoilt = {"cameras": {"02": {"video": {"stamps": ["soon"]}}}}
    monkeypatch.setattr("d2_plugin.recordings.readers.videos.read_table", lambda *_: spoilt)
    assert "videos.json (invalid literal" in refused("plan", folder, "--train-cameras", "all")


def test_a_calibration_folder_is_not_searched_without_end(given: Filmed, tmp_path, refused, monkeypatch) -> None:
    monkeypatch.setattr("d2_plugin.recordings.importing.steps.MOST_FILES", 5)
    (tmp_path / "home").mkdir()
    for number in range(6):
        (tmp_path / "home" / f"{number}.txt").write_text("")
    said = refused(*importing(replace(given, calibration=tmp_path / "home"), tmp_path / "out"))
    assert "home holds more than 5 files, which is no calibration" in said
    assert not (tmp_path / "out").exists()

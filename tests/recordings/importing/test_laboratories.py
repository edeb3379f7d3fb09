"""`d2 import` without a calibration, and stand-ins for recordings of laboratories: webcams, wide angles, a mouse."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_writers import Known, toml
from recorded import Filmed, Shooting, video, write_avi
from rigs import arc, held, worst
from stand_in_recordings import smooth_recording

from d2_plugin.commands.cli import main
from d2_plugin.durable import read_table
from d2_plugin.recordings import open_recording, select_cameras, select_frames
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import pinhole, rig_width, rigid
from d2_plugin.recordings.cameras.epipolar import rotated
from d2_plugin.recordings.export.folder import described
from d2_plugin.recordings.importing.steps import KIND
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.materials import plaster
from d2_plugin.recordings.synthetic.raycast import Room, Scene, Solid, render_color

pytest.importorskip("av")

MOMENTS = 4  # images of each webcam
STARTED = (0, 3, -2, 1.5)  # frames by which the mouse's cameras started after the first


@pytest.fixture(scope="module")
def webcams(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    """Three of one program, six frames a second, without sound, 40 degrees apart: a board is held up, no more."""
    folder, truth = tmp_path_factory.mktemp("webcams"), arc(3, 40.0, 0.75)
    taken, _ = held(truth, 0.2, MOMENTS)
    for name, images in taken.items():
        write_avi(folder / f"{name}.avi", images, 6)
    return folder, truth


def lenses(folder: Path, cameras: dict[str, Camera]) -> Path:
    entries = [
        {"name": name, "width": one.width, "height": one.height, "R": np.eye(3).tolist(), "t": [0, 0, 0]}
        | {"fx": one.K[0, 0], "fy": one.K[1, 1], "cx": one.K[0, 2], "cy": one.K[1, 2]}
        for name, one in cameras.items()
    ]
    (folder / "lenses.json").write_text(json.dumps({"cameras": entries}))
    return folder / "lenses.json"


@pytest.mark.slow
def test_webcams_with_a_board_are_placed_in_metres(webcams: tuple, tmp_path: Path, answered) -> None:
    folder, truth = webcams
    words = ["import", str(folder), "--intrinsics", str(lenses(tmp_path, truth)), "--board", "charuco:7x5:0.2:0.15"]
    words += ["--offsets", "auto", "--exposure", "false", "--images", "videos", "--output", str(tmp_path / "c")]
    assert "the board was seen by c0 in" in answered(*words)
    found = {one.name: one.pinhole() for one in open_calibration(tmp_path / "c" / "calibration.json").cameras}
    degrees, share = worst(found, truth)
    assert degrees < 0.2
    assert share < 0.005
    assert rig_width(found.values()) == pytest.approx(rig_width(truth.values()), rel=0.01)


def test_webcams_whose_board_is_hidden_from_one_are_told_so(webcams: tuple, tmp_path: Path, refused) -> None:
    folder, truth = webcams
    for path in folder.glob("*.avi"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    write_avi(tmp_path / "c2.avi", [np.full((360, 480, 3), 128, np.uint8)] * MOMENTS, 6)
    words = ["import", str(tmp_path), "--intrinsics", str(lenses(tmp_path, truth)), "--board", "charuco:7x5:0.2:0.15"]
    said = refused(*words, "--offsets", "none", "--output", str(tmp_path / "c"))
    assert "do not settle where camera c2 stands (c2 shares nothing with the others)" in said
    assert "c2 in 0 of 4 images" in said
    write_avi(tmp_path / "c2.avi", [np.full((360, 480, 3), 128, np.uint8)] * 12, 6)
    assert "--board is matched at moments" in refused(*words, "--output", tmp_path / "c")


@pytest.mark.slow
def test_xvid_at_wide_angles_is_imported_and_a_turned_camera_named(shared_data, tmp_path, capsys, answered) -> None:
    """Real images, 26 to 46 degrees apart."""
    whole = select_cameras(open_recording(shared_data("dome")), ("07", "12", "15"))
    recording = select_frames(whole, whole.frames[:2])
    (tmp_path / "videos").mkdir()
    for name in recording.cameras:
        write_avi(tmp_path / "videos" / f"{name}.avi", [recording.image(name, frame) for frame in recording.frames], 30)
    turned = rotated(recording.cameras["12"], np.deg2rad([1.2, -1.2, 1.0]))
    right, wrong = tmp_path / "right.json", tmp_path / "wrong.json"
    right.write_text(json.dumps(described(recording)))
    wrong.write_text(json.dumps(described(replace(recording, cameras={**recording.cameras, "12": turned}))))
    words = ["import", str(tmp_path / "videos"), "--offsets", "none", "--exposure", "false", "--images", "videos"]
    said = answered(*words, "--calibration", str(right), "--output", str(tmp_path / "a"))
    assert "poses hold as far as features tell: 07 within" in said
    assert "note" not in said
    words += ["--calibration", str(wrong), "--output", str(tmp_path / "b")]
    main(words)  # a warning, or refused where plain features see it as well
    named = re.search(r"camera 12 is turned by ([\d.]+) degrees \(known within", "".join(capsys.readouterr()))
    assert float(named[1]) == pytest.approx(np.linalg.norm([1.2, -1.2, 1.0]), abs=0.1)
    assert main([*words[:-1], str(tmp_path / "c"), "--refine-poses"]) == 0
    assert worst(open_recording(tmp_path / "c").cameras, recording.cameras)[0] < 0.1


@pytest.fixture(scope="module")
def mouse(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    """Four small cameras above an arena of 60 cm with bare walls, and their calibration in millimetres.

    They started by `STARTED` frames after the first.
    """
    folder, rng = tmp_path_factory.mktemp("mouse"), np.random.default_rng(0)
    (folder / "videos").mkdir()
    bare = plaster(rng)
    coat = np.clip(rng.normal(0.15, 0.08, (32, 32, 3)), 0, 1)

    def runs(seconds: float) -> tuple[np.ndarray, np.ndarray]:
        return np.eye(3), np.array([0.12 * np.cos(4 * seconds), 0.1 * np.sin(7 * seconds), 0.03])

    room = Room(np.array([-0.3, -0.3, 0.0]), np.array([0.3, 0.3, 0.5]), ((bare, bare), (bare, bare), (bare, bare)))
    scene = Scene(room, (Solid(runs, coat, np.full(3, 0.03), radius=0.03),), np.array([[0.0, 0.0, 0.48]] * 4))
    known = []
    for number, angle in enumerate(np.deg2rad([0.0, 80.0, 170.0, 260.0])):
        centre = np.array([0.24 * np.cos(angle), 0.24 * np.sin(angle), 0.4])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0.0, 0, 1]) / np.linalg.norm(np.cross(forward, [0.0, 0, 1]))
        R = np.stack([right, np.cross(forward, right), forward])
        K = pinhole(150.0, 150.0, 100.5, 80.5)
        camera = Camera(f"cam_{number}", 200, 160, K, rigid(R, -R @ centre))
        images = [render_color(scene, camera, (i + STARTED[number]) / 30) for i in range(16)]
        write_avi(folder / "videos" / f"{camera.name}.avi", images, 30)
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        known.append(Known(camera.name, (200, 160), K - half, (0.0,) * 5, R, -R @ centre * 1000))
    return Filmed(folder, toml("calibration.toml")(folder, known))


def test_a_mouse_among_four_small_cameras(mouse: Filmed, tmp_path: Path, refused) -> None:
    words = ["import", str(mouse.videos), "--calibration", str(mouse.calibration), "--images", "videos"]
    words += ["--output", str(tmp_path / "c")]
    assert "up to 480 apart, which is no metres: say what it is with --unit mm" in refused(*words)
    assert main([*words, "--unit", "mm"]) == 0
    clocks = read_table(tmp_path / "c" / "import" / "clocks.json", KIND)
    for started, (name, clock) in zip(STARTED, clocks.items(), strict=True):
        assert clock["method"] == "motion"
        off = abs(clock["seconds"] - started / 30)
        assert off <= 2 * clock["error"] + 1e-9, name
        assert off < 0.5 / 30, name
    assert rig_width(open_recording(tmp_path / "c").cameras.values()) == pytest.approx(0.48, abs=0.01)


NEIGHBOURS = ("02", "03", "04", "05")


@pytest.fixture(scope="module")
def soft(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    """Videos whose images share hardly a feature."""
    recording = smooth_recording(NEIGHBOURS, frames=2)
    return video(recording, tmp_path_factory.mktemp("soft"), {name: Shooting() for name in NEIGHBOURS})


@pytest.mark.slow
def test_videos_become_a_recording_without_a_calibration(
    shared_data: Callable[[str], Path], tmp_path, capsys, answered
) -> None:
    large = open_recording(shared_data("plaza_large"))
    near = video(select_cameras(large, NEIGHBOURS), tmp_path / "near", {name: Shooting() for name in NEIGHBOURS})
    truth = {name: large.cameras[name] for name in NEIGHBOURS}
    apart = float(np.linalg.norm(truth["02"].centre - truth["05"].centre))
    words = ["import", str(near.videos), "--output", str(tmp_path / "c"), "--offsets", "none", "--exposure", "false"]
    words += ["--scale", "0.25", "--distance", f"02,05,{apart}", "--intrinsics", str(near.calibration)]
    said = answered(*words)
    assert "camera 03: 0." in said
    assert f"scale: from the distance {apart:g} of 02 and 05" in said
    found = {camera.name: camera.pinhole() for camera in open_calibration(tmp_path / "c" / "calibration.json").cameras}
    degrees, share = worst(found, truth)
    assert degrees < 0.1
    assert share < 0.005
    assert rig_width(found.values()) == pytest.approx(rig_width(truth.values()), rel=0.005)
    told = json.loads((tmp_path / "c" / "calibration.json").read_text())
    assert {"verdict", "reprojection_error", "points", "doubt_degrees"} <= told["cameras"][0].keys()
    assert "note  poses were found from the videos; the scale of the world is from the distance" in said
    assert open_recording(tmp_path / "c").frames == (0, 1)
    before = (tmp_path / "c" / "calibration.json").read_bytes()
    assert main(words) == 0  # the same import is read, not solved again
    assert "camera 03: 0." not in capsys.readouterr().out
    assert (tmp_path / "c" / "calibration.json").read_bytes() == before


def test_cameras_that_share_nothing_are_refused_and_nothing_is_left(soft: Filmed, tmp_path: Path, refused) -> None:
    words = ["import", str(soft.videos), "--output", str(tmp_path / "c"), "--offsets", "none"]
    said = refused(*words, "--intrinsics", str(soft.calibration))
    assert "where camera 0" in said
    assert "add stills on the way between the cameras (at most 20 degrees apart)" in said
    assert not (tmp_path / "c").exists()


BAD_WORDS = [
    (["--calibration", "CALIBRATION", "--focal", "700"], r"--calibration and --focal are both given"),
    (["--unit", "mm"], r"--unit says what a calibration is in, and none is given"),
    (["--focal", "wide"], r"--focal says 'wide', expected shared, each, a number of pixels"),
    (["--focal", "02=700"], r"--focal says nothing of camera 03, 04, 05: add NAME=PIXELS"),
    (["--focal", "09=700"], r"--focal names camera '09', have 02, 03, 04, 05"),
    (["--focal", "700", "--intrinsics", "CALIBRATION"], r"--intrinsics and --focal both say how the lenses are"),
    (["--distance", "02,05"], r"--distance says '02,05', expected CAMERA,CAMERA,METRES"),
    (["--distance", "02,02,1"], r"--distance says '02,02,1', expected"),
    (["--stills", "FOLDER"], r"--stills .* is no folder with images"),
]


@pytest.mark.parametrize(("words", "says"), BAD_WORDS)
def test_words_that_say_nothing(soft: Filmed, tmp_path: Path, refused, words: list[str], says: str) -> None:
    (tmp_path / "empty").mkdir()
    places = {"CALIBRATION": str(soft.calibration), "FOLDER": str(tmp_path / "empty")}
    given = [places.get(word, word) for word in words]
    said = refused("import", soft.videos, "--output", tmp_path / "c", "--offsets", "none", *given)
    assert re.search(says, said), said
    assert not (tmp_path / "c").exists()

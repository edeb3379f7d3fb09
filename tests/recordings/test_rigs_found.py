"""Rigs whose lenses are not known, or whose cameras share a board alone; features in better places; d2 import."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import Filmed, Shooting, video
from refusals import refuses
from rigs import arc, cv2, filmed, held, seen_by, worst
from stand_in_recordings import smooth_recording

from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording, select_cameras
from d2_plugin.recordings.cameras.calibrating import Board, scaled_by_board, solve_rig
from d2_plugin.recordings.cameras.calibrating.bundle import Tracks
from d2_plugin.recordings.cameras.calibrating.features import find_features, of_a_still_camera
from d2_plugin.recordings.cameras.calibrating.sharpen import sharpened
from d2_plugin.recordings.cameras.calibrating.solve import solve_features
from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import pinhole, rig_width
from d2_plugin.recordings.recording import Camera

NEIGHBOURS = ("02", "03", "04", "05")


def blind(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """The cameras with a focal length that is far off."""
    return {
        name: replace(camera, K=pinhole(300, 300, camera.width / 2, camera.height / 2))
        for name, camera in cameras.items()
    }


class TestFocalLengths:
    """Not known beforehand."""

    @pytest.mark.parametrize("focal", ["shared", pytest.param("each", marks=pytest.mark.slow)])
    def test_are_found_with_the_poses(self, focal: str) -> None:
        truth = {
            name: replace(camera, K=pinhole(600, 600, camera.width / 2, camera.height / 2))
            for name, camera in arc().items()
        }
        rig = solve_features(seen_by(truth, things=120), blind(truth), tuple(truth), focal=focal)
        for name, camera in rig.cameras.items():
            assert camera.K[0, 0] == pytest.approx(600, rel=0.01)
            assert abs(np.log(camera.K[0, 0] / 600)) < max(2 * rig.focals[name], 0.004)
        assert len({camera.K[0, 0] for camera in rig.cameras.values()}) == (1 if focal == "shared" else len(truth))
        assert worst(rig.cameras, truth)[0] < 0.3
        assert "focal length 60" in rig.verdicts()["c0"] or "focal length 59" in rig.verdicts()["c0"]

    def test_are_found_where_matches_agree_with_any(self) -> None:
        """Two views of things without false matches look right with many focal lengths: the third one tells."""
        truth = arc(3)
        rig = solve_features(seen_by(truth, things=250), truth, tuple(truth), focal="shared")
        assert {round(float(camera.K[0, 0]) / 600, 2) for camera in rig.cameras.values()} == {1.0}
        assert worst(rig.cameras, truth)[0] < 0.1

    def test_that_the_images_do_not_tell_are_refused(self) -> None:
        truth = arc(3, 4.0)  # hardly any angle: focal length and depth change places
        with pytest.raises(D2Error, match=r"two halves of the images disagree about|do not settle"):
            solve_features(seen_by(truth, things=60), blind(truth), tuple(truth), focal="each")
        with pytest.raises(D2Error, match="c0 shares nothing with the others"):
            solve_features(seen_by(truth, things=6, wrong=1.0), blind(truth), tuple(truth), focal="shared")


class TestBoards:
    """Corners are matches, however little else two cameras share."""

    def test_an_inverted_board_and_one_of_older_programs_are_seen(self) -> None:
        images, board = filmed(arc(2), 0.25)
        assert len(board.corners(255 - images["c0"][0])) == len(board.corners(images["c0"][0])) == 24
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        older = cv2.aruco.CharucoBoard((7, 6), 0.25, 0.1875, dictionary)
        older.setLegacyPattern(True)
        drawn = cv2.copyMakeBorder(older.generateImage((420, 360)), *[60] * 4, cv2.BORDER_CONSTANT, value=128)
        assert len(replace(board, rows=6).corners(np.repeat(drawn[..., None], 3, 2))) == 30

    @pytest.mark.parametrize("size", [(8, 6), (8, 5)])
    def test_a_plain_board_that_some_see_the_other_way_up_settles_the_rig_and_its_scale(self, size) -> None:
        truth = arc(3, 40.0, 0.5)
        images, board = held(truth, 0.2, 5, plain=size)
        images["c1"] = [np.ascontiguousarray(image[::-1, ::-1]) for image in images["c1"]]  # hung upside down
        K = truth["c1"].K * [[1, 1, -1], [1, 1, -1], [1, 1, 1]] + [[0, 0, 320], [0, 0, 240], [0, 0, 0]]
        over = np.diag([-1.0, -1, 1, 1])
        truth["c1"] = replace(truth["c1"], K=K, T_camera_world=over @ truth["c1"].T_camera_world)
        rig = solve_rig(images, truth, board=board)
        degrees, share = worst(rig.cameras, truth)
        assert degrees < 0.1
        assert share < 0.003
        scaled = scaled_by_board(rig, images, board)
        assert rig_width(scaled.cameras.values()) == pytest.approx(rig_width(truth.values()), rel=0.005)
        assert "the board was seen by c0 in 5 of 5 images, c1 in" in scaled.scale

    def test_half_of_a_charuco_board_is_enough_for_the_scale_and_half_of_a_plain_one_is_not(self) -> None:
        truth = arc(3)
        images, board = filmed(truth, 0.25)
        half = {name: [taken[0].copy()] for name, taken in images.items()}
        for taken in half.values():
            taken[0][:, 320:] = 128
        rig = solve_features(seen_by(truth), truth, tuple(truth))
        scaled = scaled_by_board(rig, half, board)
        assert rig_width(scaled.cameras.values()) == pytest.approx(rig_width(truth.values()), rel=0.01)
        assert "sides of a board's squares" in scaled.scale
        blank = [np.full((480, 640, 3), 128, np.uint8)]
        one = {"c0": half["c0"], "c1": blank, "c2": blank}
        refuses(r"saw 0 sides .*c1 in 0 of 1 images.*: show the whole board", scaled_by_board, rig, one, board)
        refuses("unknown marker dictionary 'DICT_9'", scaled_by_board, rig, half, replace(board, dictionary="DICT_9"))
        refuses("saw 0 sides of the board's squares .* show", scaled_by_board, rig, half, replace(board, marker=None))

    def test_words_are_a_board_or_refused(self) -> None:
        for text in ("", "charuco:7x5:0.04", "charuco:7x5:0.03:0.04", "checkerboard:9x6:-1", "chess:9x6:0.1"):
            refuses("expected charuco:COLUMNSxROWS:SQUARE:MARKER", Board.parsed, text)
        assert Board.parsed("charuco:7x5:0.04:0.03:DICT_5X5_50") == Board(7, 5, 0.04, 0.03, "DICT_5X5_50")
        assert Board.parsed("checkerboard:9x6:0.025") == Board(9, 6, 0.025)


class TestPlaces:
    """Of features."""

    def test_features_are_moved_to_where_their_surroundings_are(self) -> None:
        rng = np.random.default_rng(0)
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)).astype(np.float32), (0, 0), 2.5)
        grey = np.clip((noise - noise.mean()) * 8 + 128, 0, 255).astype(np.uint8)
        warp = np.array([[1.05, 0.08, -9.3], [-0.05, 0.96, 6.7]])  # what a slanted surface does to an image
        other = np.clip(0.8 * cv2.warpAffine(grey, warp, (320, 240), flags=cv2.INTER_CUBIC) + 10, 0, 255)
        one, two = (find_features([np.repeat(p.astype(np.uint8)[..., None], 3, 2)]) for p in (grey, other))
        inside = np.all((one.pixels > 40) & (one.pixels < (280, 200)), axis=1)
        expected = (one.pixels - 0.5) @ warp[:, :2].T + warp[:, 2] + 0.5
        rows = np.flatnonzero(inside)[:150]
        two = replace(two, pixels=expected[rows] + rng.normal(0, 0.4, (len(rows), 2)), shapes=one.shapes[rows])
        two = replace(two, moments=np.zeros(len(rows), int))
        tracks = Tracks(("a", "b"), np.stack([rows, np.arange(len(rows))], axis=1))
        camera = Camera("a", 320, 240, pinhole(300, 300, 160, 120), np.eye(4))
        better, kept = sharpened({"a": one, "b": two}, tracks, {"a": camera, "b": camera})
        assert len(kept.seen) > 0.9 * len(rows)
        off = better["b"].pixels[kept.seen[:, 1]] - expected[kept.seen[:, 0]]
        assert np.median(np.linalg.norm(off, axis=1)) < 0.06  # of half a pixel; OpenCV warps by 32nds of a pixel
        assert np.array_equal(better["a"].pixels, one.pixels)

    def test_what_stands_still_is_one_witness(self) -> None:
        rng = np.random.default_rng(0)
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160)).astype(np.float32), (0, 0), 2)
        wall = np.repeat(noise[..., None], 3, 2)
        taken = []
        for moment in range(5):
            image = wall.copy()
            image[40:60, 20 * moment : 20 * moment + 20] = rng.uniform(0, 255, (20, 20, 1))
            taken.append(np.clip((image - 128) * 3 + 128, 0, 255).astype(np.uint8))
        found = of_a_still_camera(taken)
        assert np.mean(found.moments == 0) > 0.5
        moving = found.pixels[found.moments > 0]
        assert np.all((moving[:, 1] > 30) & (moving[:, 1] < 70))


@pytest.fixture(scope="module")
def soft(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    """Videos whose images share hardly a feature."""
    pytest.importorskip("av")
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
    (["--board", "a4"], r"--board says 'a4', expected charuco"),
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

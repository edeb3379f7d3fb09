"""Poses and lenses from what cameras saw of the same things: refined, found, scaled, refused where nothing settles."""

import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from rigs import NOISE, arc, filmed, held, moved, seen_by, worst

from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording, select_cameras
from d2_plugin.recordings.cameras.calibrating import Board, scaled_by_board
from d2_plugin.recordings.cameras.calibrating.bundle import Tracks
from d2_plugin.recordings.cameras.calibrating.features import find_features, of_a_still_camera
from d2_plugin.recordings.cameras.calibrating.refine import Turn, refine_poses, turns_in_words
from d2_plugin.recordings.cameras.calibrating.sharpen import sharpened
from d2_plugin.recordings.cameras.calibrating.solve import solve_features, solve_rig
from d2_plugin.recordings.cameras.camera import pinhole, rig_width
from d2_plugin.recordings.cameras.epipolar import degrees_between
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.selection import spread

pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")
cv2 = pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")


class TestRefinedPoses:
    """Better where that is proven, else as they were given."""

    def test_a_degree_and_a_hundredth_become_a_tenth(self) -> None:
        truth = arc()
        given = moved(truth, 1.0, 0.01)
        refined = refine_poses(given, seen_by(truth))
        assert refined.accepted, refined.reason
        before, after = worst(given, truth), worst(refined.cameras, truth)
        assert after[0] < 0.1 * before[0]
        assert after[1] < 0.1 * before[1] + 5e-4
        assert refined.pixels_after < 0.5 * refined.pixels_before
        assert "poses refined: the error fell from" in refined.reason
        centres = [np.mean([camera.centre for camera in rig.values()], axis=0) for rig in (refined.cameras, given)]
        np.testing.assert_allclose(*centres, atol=1e-9)  # the rig as a whole stays where it was

    @pytest.mark.parametrize("degrees", [0.25, 2.0])
    def test_one_camera_that_is_turned_is_named_and_mended(self, degrees: float) -> None:
        truth = arc()
        refined = refine_poses({**truth, "c2": moved(truth, degrees, 0.0)["c2"]}, seen_by(truth))
        assert [name for name, turn in refined.turns.items() if turn.wrong] == ["c2"]
        assert refined.turns["c2"].degrees == pytest.approx(degrees, abs=0.1)
        assert "camera c2 is turned by" in turns_in_words(refined.turns, truth)[0]
        assert max(degrees_between(refined.cameras[name], truth[name]) for name in truth) < 0.1

    def test_poses_that_features_settle_within_degrees_are_not_called_right(self) -> None:
        assert turns_in_words({"a": Turn(0.1, 0.05, 0.2, False), "b": Turn(1.0, 7.9, 1.5, False)}, "abc") == [
            "poses hold as far as features tell: a within 0.10 degrees (0.2 pixels)",
            "poses that features hardly tell anything of: b within 7.90 degrees (1.5 pixels)",
            "poses not checked: c, too few shared features",
        ]

    def test_right_poses_stay(self) -> None:
        truth = arc()
        refined = refine_poses(truth, seen_by(truth))
        assert not refined.accepted
        assert refined.cameras == truth
        assert "the poses stay" in refined.reason
        assert not any(turn.wrong for turn in refined.turns.values())

    def test_matches_that_are_all_wrong_change_nothing(self) -> None:
        truth = arc(2)
        given = moved(truth, 1.0, 0.01)
        refined = refine_poses(given, seen_by(truth, things=80, wrong=1.0))
        assert not refined.accepted
        assert refined.cameras == given

    def test_a_camera_that_shares_nothing_is_named(self) -> None:
        truth = arc()
        features = seen_by(truth)
        features["c3"] = seen_by(truth, seed=9)["c3"]
        refined = refine_poses(truth, features)
        assert not refined.accepted
        assert "the poses stay: camera c3 shares too few features" in refined.reason


class TestRigsFromImagesAlone:
    """Known intrinsics, nothing else."""

    def test_four_cameras_25_degrees_apart(self) -> None:
        truth = arc()
        rig = solve_features(seen_by(truth), truth, tuple(truth))
        degrees, share = worst(rig.cameras, truth)
        assert degrees < 0.1
        assert share < 0.003
        assert rig_width(rig.cameras.values()) == pytest.approx(1)
        np.testing.assert_allclose(rig.cameras["c0"].T_camera_world, np.eye(4), atol=1e-12)
        assert all(pixels < 3 * NOISE for pixels in rig.pixels.values())
        assert rig.scale.startswith("arbitrary")
        assert rig.verdicts()["c2"].startswith(f"{rig.pixels['c2']:.2f} pixels over ")
        metres = rig.scaled("c0", "c3", 2.5)
        assert np.linalg.norm(metres.cameras["c0"].centre - metres.cameras["c3"].centre) == pytest.approx(2.5)
        refuses("name two cameras of c0, c1, c2, c3", rig.scaled, "c0", "c9", 1)

    def test_two_stills_between_connect_two_cameras_that_share_nothing(self) -> None:
        truth = arc(4, 15.0)
        features = seen_by(truth)
        rng = np.random.default_rng(1)
        for name, first in (("c0", 0), ("c3", 1)):  # every other thing is lost on either side, in turn
            strange = rng.normal(size=features[name].descriptors[first::2].shape).astype(np.float32)
            descriptors = features[name].descriptors.copy()
            descriptors[first::2] = strange / np.linalg.norm(strange, axis=1, keepdims=True)
            features[name] = replace(features[name], descriptors=descriptors)
        outer = {name: features[name] for name in ("c0", "c3")}
        refuses("do not settle where camera c0, c3 stands", solve_features, outer, truth, ("c0", "c3"))
        rig = solve_features(features, truth, ("c0", "c3"))
        assert list(rig.cameras) == ["c0", "c3"]
        assert worst(rig.cameras, {name: truth[name] for name in ("c0", "c3")})[0] < 0.3

    def test_matches_that_are_all_wrong_are_refused(self) -> None:
        truth = arc(2)
        refuses("add stills", solve_features, seen_by(truth, things=80, wrong=1.0), truth, tuple(truth))


@pytest.mark.slow
def test_a_real_rig_with_neighbours_up_to_42_degrees_apart_is_settled(shared_data: Callable[[str], Path]) -> None:
    dome = select_cameras(open_recording(shared_data("dome")), ("03", "07", "12", "15"))
    images = {name: [dome.image(name, frame) for frame in spread(dome.frames, 8)] for name in dome.cameras}
    rig = solve_rig(images, dome.cameras)  # without views from aside the halves differ by .9 % of the rig
    assert worst(rig.cameras, dome.cameras)[0] < 0.2


def with_focal(cameras: dict[str, Camera], focal: float) -> dict[str, Camera]:
    """The cameras with a focal length of so many pixels, straight behind the middle of the image."""
    return {
        name: replace(camera, K=pinhole(focal, focal, camera.width / 2, camera.height / 2))
        for name, camera in cameras.items()
    }


class TestFocalLengths:
    """Not known beforehand."""

    @pytest.mark.parametrize("focal", ["shared", pytest.param("each", marks=pytest.mark.slow)])
    def test_are_found_with_the_poses(self, focal: str) -> None:
        truth = with_focal(arc(), 600)
        rig = solve_features(seen_by(truth, things=120), with_focal(truth, 300), tuple(truth), focal=focal)
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
        blind = with_focal(truth, 300)
        with pytest.raises(D2Error, match=r"two halves of the images disagree about|do not settle"):
            solve_features(seen_by(truth, things=60), blind, tuple(truth), focal="each")
        with pytest.raises(D2Error, match="c0 shares nothing with the others"):
            solve_features(seen_by(truth, things=6, wrong=1.0), blind, tuple(truth), focal="shared")


class TestBoards:
    """Corners are matches, however little else two cameras share."""

    def test_an_inverted_board_and_one_of_older_programs_are_seen(self) -> None:
        images, board = filmed(arc(2), 0.25)
        assert len(board.corners(255 - images["c0"][0])) == len(board.corners(images["c0"][0])) == 24
        older = cv2.aruco.CharucoBoard((7, 6), 0.25, 0.1875, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
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
        for text in ("", "a4", "charuco:7x5:0.04", "charuco:7x5:0.03:0.04", "checkerboard:9x6:-1", "chess:9x6:0.1"):
            refuses("expected charuco:COLUMNSxROWS:SQUARE:MARKER", Board.parsed, text)
        assert Board.parsed("charuco:7x5:0.04:0.03:DICT_5X5_50") == Board(7, 5, 0.04, 0.03, "DICT_5X5_50")
        assert Board.parsed("checkerboard:9x6:0.025") == Board(9, 6, 0.025)


class TestPlaces:
    """Of features."""

    def test_features_lie_where_things_are_not_a_quarter_of_a_pixel_beside(self) -> None:
        y, x = np.mgrid[:120, :120] + 0.5
        centres = np.array([[30.3, 40.7], [80.25, 70.5], [90.8, 25.1], [40.4, 90.9]])
        grey = sum(200 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 40) for cx, cy in centres)
        image = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        found = find_features([image]).pixels
        for centre in centres:
            nearest = found[np.linalg.norm(found - centre, axis=1).argmin()]
            np.testing.assert_allclose(nearest, centre, atol=0.1)

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

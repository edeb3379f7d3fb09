"""Poses from what cameras saw of the same things: refined, found, scaled, and refused where that settles nothing."""

import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from rigs import NOISE, arc, moved, seen_by, worst

from d2_plugin.recordings import open_recording, select_cameras
from d2_plugin.recordings.cameras.calibrating.features import find_features
from d2_plugin.recordings.cameras.calibrating.refine import Turn, refine_poses, turns_in_words
from d2_plugin.recordings.cameras.calibrating.solve import solve_features, solve_rig
from d2_plugin.recordings.cameras.camera import rig_width
from d2_plugin.recordings.cameras.epipolar import degrees_between
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
        given = {**truth, "c2": moved(truth, degrees, 0.0)["c2"]}
        refined = refine_poses(given, seen_by(truth))
        assert [name for name, turn in refined.turns.items() if turn.wrong] == ["c2"]
        assert refined.turns["c2"].degrees == pytest.approx(degrees, abs=0.1)
        assert "camera c2 is turned by" in turns_in_words(refined.turns, truth)[0]
        assert max(degrees_between(refined.cameras[name], truth[name]) for name in truth) < 0.1

    def test_poses_that_features_settle_within_degrees_are_not_called_right(self) -> None:
        said = turns_in_words({"a": Turn(0.1, 0.05, 0.2, False), "b": Turn(1.0, 7.9, 1.5, False)}, "abc")
        assert said == [
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


def test_features_lie_where_things_are_not_a_quarter_of_a_pixel_beside() -> None:
    y, x = np.mgrid[:120, :120] + 0.5
    centres = np.array([[30.3, 40.7], [80.25, 70.5], [90.8, 25.1], [40.4, 90.9]])
    grey = sum(200 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 40) for cx, cy in centres)
    image = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    found = find_features([image]).pixels
    for centre in centres:
        nearest = found[np.linalg.norm(found - centre, axis=1).argmin()]
        np.testing.assert_allclose(nearest, centre, atol=0.1)

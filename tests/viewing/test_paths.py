"""Camera paths: they begin and end where they say, look where the cameras look, and stay where the cameras saw."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.camera import focus_of, look_at
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.viewing.camera_paths import MARGIN, Rig, camera_path_text, for_size, orbit, read_camera_path

ARC = list(synthetic_recording(cameras=4, held_out=0, frames=1, width=96, height=54).cameras.values())


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Cameras all around the origin, upright, y down."""
    angles = 2 * np.pi * np.arange(count) / count
    centres = radius * np.stack([np.sin(angles), np.zeros(count), np.cos(angles)], -1)
    poses = [look_at(centre, np.zeros(3), np.array([0.0, -1, 0])) for centre in centres]
    return [replace(ARC[0], name=f"{i}", T_camera_world=pose) for i, pose in enumerate(poses)]


def focus(cameras: list[Camera]) -> np.ndarray:
    return focus_of(np.stack([c.centre for c in cameras]), np.stack([c.T_camera_world[2, :3] for c in cameras]))


@pytest.mark.parametrize("cameras", [ARC, ARC[:2], ARC[:1], ring(8)], ids=["arc", "two", "one", "ring"])
def test_every_pose_of_an_orbit_is_a_camera_pose(cameras: list[Camera]) -> None:
    poses = orbit(cameras, 17)
    assert len(poses) == 17
    for pose in poses:
        R = pose.T_camera_world[:3, :3]
        assert np.isfinite(pose.T_camera_world).all()
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0


def test_an_orbit_looks_at_the_focus_from_one_distance_and_stays_inside_the_cameras() -> None:
    point, poses = focus(ARC), orbit(ARC, 40)
    assert np.ptp([np.linalg.norm(pose.centre - point) for pose in poses]) < 1e-9
    for pose in poses:
        ahead = pose.T_camera_world[:3, :3] @ point + pose.T_camera_world[:3, 3]
        assert np.allclose(ahead[:2], 0, atol=1e-9)
        assert ahead[2] > 0
    widest = max(np.linalg.norm(a.centre - b.centre) for a in ARC for b in ARC)
    swung = max(np.linalg.norm(a.centre - b.centre) for a in poses for b in poses)
    assert 0.7 * widest < swung < 1.1 * widest


def test_cameras_all_around_are_orbited_by_a_whole_turn() -> None:
    poses = orbit(ring(8), 36)
    assert all(one.T_camera_world[1, 1] > 0 for one in (*ring(8), *poses)), "upright"
    places = np.stack([pose.centre for pose in poses])
    assert np.allclose(np.linalg.norm(places, axis=1), 3)
    assert np.allclose(places.mean(axis=0), 0, atol=1e-9)
    quarter = np.stack([pose.centre for pose in orbit(ring(8), 36, degrees=90)])
    assert np.linalg.norm(quarter.mean(axis=0)) > 1


def test_home_and_the_limits_of_a_free_camera_follow_from_where_cameras_stood() -> None:
    rig = Rig.of(ARC, None)
    limits = rig.limits(ARC)
    assert np.allclose((rig.home[:3, :3] @ rig.focus + rig.home[:3, 3])[:2], 0, atol=1e-9)
    low, high = np.degrees(limits["azimuth"])
    assert high - low == pytest.approx(rig.span + 2 * MARGIN, abs=0.1)
    distances = [np.linalg.norm(camera.centre - rig.focus) for camera in ARC]
    assert limits["distance"][0] < min(distances) <= max(distances) < limits["distance"][1]
    assert limits["elevation"][0] < limits["elevation"][1]
    assert Rig.of(ring(8), None).limits(ring(8))["azimuth"] is None


def test_parallel_cameras_have_a_focus_in_front_of_them() -> None:
    forwards = np.tile([0.0, 0, 1], (2, 1))
    assert np.allclose(focus_of(np.array([[0.0, 0, 0], [1, 0, 0]]), forwards, depth=5.0), [0.5, 0, 5])


@pytest.mark.parametrize("size", [(192, 108), (48, 27), (100, 54), (54, 96)])
def test_a_lens_of_another_size_keeps_its_shape_and_its_middle(size: tuple[int, int]) -> None:
    other = for_size(replace(ARC[0], K=np.array([[90.0, 0, 50], [0, 90.0, 25], [0, 0, 1]])), *size)
    scale = max(size[0] / 96, size[1] / 54)
    assert np.isclose(other.K[0, 0], other.K[1, 1])
    assert np.isclose(other.K[0, 0], 90 * scale)
    assert np.allclose(other.K[:2, 2] - np.array(size) / 2, (np.array([50, 25]) - np.array([48, 27])) * scale)


SOMEWHERE = np.eye(4).flatten().tolist()


class TestCameraPathFiles:
    @staticmethod
    def write(folder: Path, **more: object) -> Path:
        path = folder / "camera_path.json"
        table = json.loads(camera_path_text([ARC[0], ARC[0]], [0.0, 1.0], 24))
        for entry in table["camera_path"]:
            del entry["render_time"]
        path.write_text(json.dumps({name: value for name, value in table.items() if name != "seconds"} | more))
        return path

    def test_a_path_that_is_written_is_read(self, tmp_path: Path) -> None:
        path = tmp_path / "camera_path.json"
        path.write_text(camera_path_text(ARC[:3], [0.0, 0.25, 1.0], 24))
        found = read_camera_path(path)
        assert (found.fps, found.shares) == (24, [0.0, 0.25, 1.0])
        for camera, true in zip(found.cameras, ARC[:3], strict=True):
            assert np.allclose(camera.T_camera_world, true.T_camera_world)
            assert np.isclose(camera.K[1, 1], true.K[1, 1])

    def test_it_lasts_as_long_as_it_says_and_times_count_only_where_all_have_one(self, tmp_path: Path) -> None:
        assert read_camera_path(self.write(tmp_path, seconds=4.0)).fps == 0.5
        path = self.write(tmp_path)
        table = json.loads(path.read_text())
        table["camera_path"][0]["render_time"] = 0.25
        path.write_text(json.dumps(table))
        assert read_camera_path(path).shares is None
        table["camera_path"][1]["render_time"] = 2.0
        path.write_text(json.dumps(table))
        assert read_camera_path(path).shares == [0.25, 1.0]

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"camera_type": "fisheye"}, "of type 'fisheye', expected perspective"),
            ({"camera_path": []}, "has no camera"),
            ({"camera_path": [{"fov": 50}]}, "camera 0 of .* has no camera_to_world"),
            ({"camera_path": [{"fov": 0, "camera_to_world": SOMEWHERE}]}, "fov of camera 0 of .* must be above 0"),
            ({"camera_path": [{"fov": 50, "camera_to_world": SOMEWHERE[:3]}]}, "expected 4 x 4 numbers"),
            ({"camera_path": [{"fov": 50, "camera_to_world": [0.0] * 15 + [1]}]}, "an R that is no rotation"),
            ({"camera_path": [{"fov": 50, "camera_to_world": [*SOMEWHERE[:15], 0]}]}, "ends with .*expected 0 0 0 1"),
            ({"camera_path": [{"fov": 50, "camera_to_world": [1e300] * 16}]}, "not finite or too large"),
            ({"camera_path": [{"fov": 0.01, "camera_to_world": SOMEWHERE}]}, "degrees, expected 0.5 to 178"),
            ({"camera_path": [None]}, "camera 0 of .* is no object"),
            ({"render_width": 10**9}, "render_width of .* must be at least 1 and at most 65535"),
        ],
    )
    def test_another_file_is_refused_in_a_sentence(self, tmp_path: Path, change: dict, said: str) -> None:
        refuses(said, read_camera_path, self.write(tmp_path, **change))

"""What is looked at before work begins: calibrations that contradict the images, exposures, empty images, memory."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from prior_cases import showing, world_points
from recorded import graded
from refusals import refuses

from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording, open_recording, select_cameras
from d2_plugin.recordings.cameras import check
from d2_plugin.recordings.cameras.camera import checked_camera
from d2_plugin.recordings.cameras.check import check_recording
from d2_plugin.recordings.cameras.epipolar import rotated
from d2_plugin.recordings.checks import memory as memory_module
from d2_plugin.recordings.checks.exposure import relative_exposures
from d2_plugin.recordings.checks.memory import check_memory, needed_bytes
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.plan import appearance_decision

pytest.importorskip("cv2", reason="opencv is in the `image` extra")


W, H = 240, 135


@pytest.fixture(scope="module")
def room() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=2, width=W, height=H)


def moved(recording: Recording, name: str, **changes: object) -> Recording:
    """The same images with another calibration of one camera."""
    return replace(recording, cameras={**recording.cameras, name: replace(recording.cameras[name], **changes)})


def notes_of(recording: Recording) -> tuple[str, ...]:
    return check_recording(recording, list(recording.cameras), list(recording.cameras))


@pytest.mark.parametrize("name", ["n3dv_sear_steak_t0", "pose2sim_single", "plaza"])
def test_real_and_rendered_recordings_have_nothing_to_be_noted(name: str, shared_data: Callable[[str], Path]) -> None:
    recording = open_recording(shared_data(name))
    assert notes_of(select_cameras(recording, list(recording.cameras)[:4])) == ()


def test_a_transposed_rotation_of_a_real_camera_is_named(shared_data: Callable[[str], Path]) -> None:
    recording = open_recording(shared_data("n3dv_sear_steak_t0"), downscale=2)
    T = recording.cameras["cam05"].T_camera_world.copy()
    T[:3, :3] = T[:3, :3].T
    (note,) = notes_of(moved(recording, "cam05", T_camera_world=T))
    assert "the calibration misses features that two images share" in note
    assert note.endswith("check R, t and K of camera cam05")


def test_one_bad_pair_does_not_overrule_all_others() -> None:
    distances = {(a, b): 151.0 if a + b == "ad" else 1.0 for a, b in combinations("abcd", 2)}
    checked = [check._Pair(*pair, distance, distance > 1, 40) for pair, distance in distances.items()]
    assert check._suspects(checked) == ""
    assert "features of a and d by 151 pixels, but not those of their other pairs" in check._missed(checked)


def test_a_right_calibration_of_a_real_dome_is_not_called_wrong(shared_data: Callable) -> None:
    recording = open_recording(shared_data("dome"), cameras=("02", "03", "05", "07", "12", "15", "18", "22"))
    assert check.calibration_contradicted(recording) == (False, "")


@pytest.mark.parametrize(("bad", "degrees"), [("03", 4), ("12", 3)])
def test_the_turned_camera_of_a_real_dome_is_named(bad: str, degrees: float, shared_data: Callable) -> None:
    recording = open_recording(shared_data("dome"))
    turned = rotated(recording.cameras[bad], np.deg2rad(degrees) * np.array([0.5, 0.5, 0.7]))
    wrong, why = check.calibration_contradicted(moved(recording, bad, T_camera_world=turned.T_camera_world))
    assert wrong
    assert why.endswith(f"check R, t and K of camera {bad}")


def test_a_camera_that_looks_away_is_named(room: Recording) -> None:
    name = next(iter(room.cameras))
    about = np.diag([-1.0, 1.0, -1.0, 1.0]) @ room.cameras[name].T_camera_world
    notes = notes_of(moved(room, name, T_camera_world=about))
    assert f"camera {name} sees nothing that another camera sees: check its R and t" in notes


def test_a_rig_far_from_the_origin_is_named_and_one_whose_places_float32_cannot_hold_refused(room: Recording) -> None:
    def shifted(by: float) -> Recording:
        recording = room
        for name, camera in room.cameras.items():
            T = camera.T_camera_world.copy()
            T[:3, 3] -= T[:3, :3] @ np.array([by, 0, 0])
            recording = moved(recording, name, T_camera_world=T)
        return recording

    says = "positions lose digits in float32, so move the origin to the scene"
    assert any(says in note for note in notes_of(shifted(5e4)))
    refuses(says, notes_of, shifted(4e6))
    one_spot = {
        name: replace(camera, T_camera_world=shifted(4e6).cameras["train0"].T_camera_world)
        for name, camera in room.cameras.items()
    }
    refuses(says, notes_of, replace(room, cameras=one_spot))


def test_centimetres_and_milliseconds_are_named(room: Recording) -> None:
    """The bundled 4D Gaussians lose 5 to 8 dB of what moves so."""
    poses = {name: camera.T_camera_world.copy() for name, camera in room.cameras.items()}
    wide = room
    for name, pose in poses.items():
        pose[:3, 3] *= 100
        wide = moved(wide, name, T_camera_world=pose, near_far=None)
    assert any("so give metres" in note for note in notes_of(wide))
    assert any("frames per unit of time" in note for note in notes_of(replace(room, fps=room.fps / 1000)))
    assert not notes_of(room)


def test_images_of_one_colour_are_named(room: Recording) -> None:
    name = next(iter(room.cameras))
    notes = notes_of(showing(room, {"image": lambda camera, frame: np.full((H, W, 3), 200 * frame, np.uint8)}))
    assert f"camera {name} is black at frame 0: nothing can be learned from that" in notes
    assert f"camera {name} is of one colour at frame 1: nothing can be learned from that" in notes


def test_images_of_ten_or_twelve_bits_in_sixteen_are_named(room: Recording) -> None:
    name = next(iter(room.cameras))
    dark = showing(room, {"image": lambda camera, frame: room.image(camera, frame) >> 4 * (frame == 1)})
    (note,) = (note for note in notes_of(dark) if name in note)
    assert note.startswith(f"camera {name} is nearly black, at most 16 of 255, at frame 1: white is 255")


def test_a_mask_of_zeros_and_ones_is_named(room: Recording) -> None:
    name = next(iter(room.cameras))
    inside = np.zeros((H, W), np.float32)
    inside[40:80, 60:120] = 1
    masks = {"mask": lambda camera, frame: inside / np.float32(255 if camera == name else 1)}
    (note,) = notes_of(showing(room, masks))
    assert note.startswith(f"the foreground mask of camera {name} is nearly black at frame 0, 1: white, 255 of 255")


def test_too_little_memory_is_said_before_work_begins(room: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    large = room
    for name, camera in room.cameras.items():
        large = moved(large, name, width=8000, height=4500, K=camera.K * [[8000 / W], [4500 / H], [1]])
    names = list(room.cameras)[:2]
    assert 7 < needed_bytes(large, names) / 2**30 < 9, "7.4 GiB were measured for two images of 8000x4500"
    monkeypatch.setattr(memory_module, "available_bytes", lambda: 4 << 30)
    refuses(r"2 cameras of 8000x4500 pixels need about 8\.\d GiB .* use --downscale 2", check_memory, large, names)
    check_memory(room, names)
    monkeypatch.setattr(memory_module, "available_bytes", lambda: 1 << 20)
    refuses("a machine with more memory", check_memory, large, names)
    monkeypatch.setattr(memory_module, "available_bytes", lambda: None)
    check_memory(large, names)


@pytest.mark.parametrize("place", [(1e9, H / 2), (W / 2, -1e6)])
def test_a_principal_point_far_from_the_image_is_refused(room: Recording, place: tuple[float, float]) -> None:
    camera = next(iter(room.cameras.values()))
    K = camera.K.copy()
    K[:2, 2] = place
    with pytest.raises(D2Error, match=r"principal point .* degrees from the middle of the image, expected at most 80"):
        checked_camera("a", (W, H), K, camera.T_camera_world, None, "cameras.json")
    part = camera.K.copy()  # of an image of 40 times the width, as a crop of a large one is
    part[:2] *= 40
    checked_camera("a", (W, H), part, camera.T_camera_world, None, "cameras.json")


CAMERAS = ("train0", "train1", "train2")


@pytest.fixture(scope="module")
def wide_room() -> tuple[Recording, np.ndarray, np.ndarray]:
    """A recording and surface points seen in its first image, some of them hidden from the others."""
    recording = synthetic_recording(cameras=4, frames=2, width=160, height=90)
    world = world_points(recording.cameras["train1"], recording.depth("train1", 0)).reshape(90, 160, 3)
    points = world[3:87:4, 3:157:4].reshape(-1, 3)
    return recording, points, np.zeros(len(points))


def exposed(recording: Recording, gains: dict[str, tuple[float, float, float]]) -> Recording:
    """The recording with a gain per camera and channel."""

    def image(camera: str, frame: int) -> np.ndarray:
        return graded(recording.image(camera, frame), gains.get(camera, (1, 1, 1)))

    return showing(recording, {"image": image})


def test_gains_and_white_balance_are_found_and_equal_exposures_agree(wide_room: tuple) -> None:
    recording, points, times = wide_room
    plain = relative_exposures(recording, CAMERAS, points, times).gains
    assert np.abs(plain).max() < 0.02
    decision = appearance_decision(recording, CAMERAS, points, times)
    assert not decision.use
    assert "exposures agree" in decision.reason
    gains = {"train0": (0.8, 0.8, 0.9), "train2": (1.1, 1.0, 1.0)}
    found = relative_exposures(exposed(recording, gains), CAMERAS, points, times)
    expected = np.log([gains.get(camera, (1, 1, 1)) for camera in CAMERAS])
    assert np.abs(found.gains - plain - (expected - expected.mean(0))).max() < 0.02
    decision = appearance_decision(exposed(recording, gains), CAMERAS, points, times)
    assert decision.use
    assert "exposures differ" in decision.reason


def test_too_few_points_or_one_camera_decide_nothing(wide_room: tuple) -> None:
    recording, points, times = wide_room
    assert relative_exposures(recording, CAMERAS, points[:5], times[:5]) is None
    assert relative_exposures(recording, CAMERAS, points[:0], times[:0]) is None
    assert not appearance_decision(recording, CAMERAS, points[:5], times[:5]).use
    assert appearance_decision(recording, CAMERAS[:1], points, times).impossible

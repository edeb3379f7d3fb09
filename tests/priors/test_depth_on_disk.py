"""Depth on disk: sensor maps, confidences and COLMAP workspaces become geometric depth in our units, or are refused."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from prior_cases import plane_seen_by, showing, write_dense_array
from refusals import refuses

from d2_plugin.errors import D2Error
from d2_plugin.priors import depth_on_disk
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.colmap.workspace import WorkspaceDepth, scale_of_world, seen_by
from d2_plugin.priors.depth_on_disk import DepthOnDisk, SensorDepth, find_depth_on_disk, flying_pixels
from d2_plugin.priors.frame import Frame
from d2_plugin.priors.geometry import index_intrinsics
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.cameras.camera import pinhole
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.selection import downscale
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

cv2 = pytest.importorskip("cv2")
NAMES = ["train0", "train1", "train2"]
AUTO = StereoSettings()
SENSOR = StereoSettings(matcher="sensor")


@pytest.fixture(scope="module")
def plain() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=2, width=160, height=90, arc_degrees=20)


@pytest.fixture
def recording(plain: Recording, tmp_path: Path) -> Recording:
    return replace(plain, path=tmp_path)


@pytest.fixture
def still(recording: Recording) -> Recording:
    """One instant of it."""
    return replace(recording, frames=(0,))


def write_sensor(recording: Recording, description: dict, step: float = 1e-3, suffix: str = ".png") -> Path:
    """Sensor maps of the first two cameras, `step` world units a number."""
    folder = recording.path / "depth"
    for name in list(recording.cameras)[:2]:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for frame in recording.frames:
            stored = recording.depth(name, frame) / step
            path = folder / name / f"{frame:05d}{suffix}"
            whole = np.rint(stored).astype(np.uint16)
            assert cv2.imwrite(str(path), whole) if suffix == ".png" else np.save(path, stored) is None
    (folder / "depth.json").write_text(json.dumps(description))
    return folder


def write_maps(recording: Recording, place: str, frame: int, scale: float = 1.0) -> Path:
    """A workspace with the true depth of all cameras in a world of another scale, and COLMAP's text model without
    points. Its PatchMatch takes K in array indices."""
    folder = recording.path / place
    maps = folder / "stereo" / "depth_maps"
    maps.mkdir(parents=True)
    (folder / "sparse").mkdir()
    model = {"cameras": "", "images": "", "points3D": ""}
    for index, camera in enumerate(recording.cameras.values(), 1):
        K, pose = index_intrinsics(camera), camera.T_camera_world
        placed = " ".join(map(str, (*quaternion_of_rotation(pose[:3, :3]), *(scale * pose[:3, 3]))))
        lens = f"{camera.width} {camera.height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
        model["cameras"] += f"{index} PINHOLE {lens}\n"
        model["images"] += f"{index} {placed} {index} {camera.name}.png\n\n"
        write_dense_array(maps / f"{camera.name}.png.geometric.bin", recording.depth(camera.name, frame) * scale)
    for name, lines in model.items():
        (folder / "sparse" / f"{name}.txt").write_text(lines)
    return folder


def workspace(recording: Recording, place: str = "") -> WorkspaceDepth:
    found = find_depth_on_disk(recording, NAMES, StereoSettings(matcher="workspace", folder=place))
    assert isinstance(found, WorkspaceDepth)
    return found


@pytest.mark.parametrize(
    ("description", "step", "suffix"),
    [({"unit": "mm"}, 1e-3, ".png"), ({"scale": 0.0005}, 5e-4, ".png"), ({"unit": "m"}, 1.0, ".npy")],
)
def test_sensor_depth_comes_in_world_units(recording: Recording, description: dict, step: float, suffix: str) -> None:
    write_sensor(recording, description, step, suffix)
    found = find_depth_on_disk(recording, NAMES, SENSOR)
    assert found.name == "sensor"
    depth = found.depth(recording.cameras["train1"], 1)
    np.testing.assert_allclose(depth, recording.depth("train1", 1), atol=0.51 * step if suffix == ".png" else 1e-6)
    assert found.depth(recording.cameras["train2"], 1) is None
    assert found.depth(recording.cameras["train1"], 7) is None


def test_sensor_depth_comes_at_the_size_of_the_images_and_empty_where_it_is_none(recording: Recording) -> None:
    folder = write_sensor(recording, {"unit": "m"}, 1.0, ".npy")
    smaller = downscale(recording, 3)
    depth = SensorDepth(folder, NAMES).depth(smaller.cameras["train0"], 0)
    np.testing.assert_allclose(depth, smaller.depth("train0", 0), rtol=1e-6)
    coarse = recording.depth("train0", 0)[::2, ::2].copy()
    coarse[0, :4] = np.nan, np.inf, -1, 0
    np.save(folder / "train0" / "00000.npy", coarse)
    depth = SensorDepth(folder, NAMES).depth(recording.cameras["train0"], 0)
    coarse[0, :4] = 0
    np.testing.assert_array_equal(depth, coarse.repeat(2, 0).repeat(2, 1))


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"unit": "m", "scale": 1}, "either scale .* or unit"),
        ({"unit": "feet"}, "unknown unit of .*depth.json 'feet'"),
        ({"scale": -1}, "scale of .*depth.json must be above 0, got -1"),
        ({"scale": 1, "along": "rays"}, "unknown along of .*depth.json 'rays'.*ray"),
        ({"scale": "1"}, "scale of .*depth.json must be a number, got '1'"),
        ([], "either scale .* or unit"),
    ],
)
def test_what_a_stored_number_means_must_be_declared(recording: Recording, description: object, message: str) -> None:
    write_sensor(recording, description)
    refuses(message, find_depth_on_disk, recording, NAMES, SENSOR)


def test_a_map_that_is_no_depth_is_named(recording: Recording) -> None:
    folder = write_sensor(recording, {"unit": "mm"})
    camera, sensor = recording.cameras["train0"], SensorDepth(folder, NAMES)
    path = folder / "train0" / "00000.png"
    assert cv2.imwrite(str(path), np.zeros((90, 160), np.uint8))
    refuses(r"00000.png is uint8 .* 16 bits", sensor.depth, camera, 0)
    path.write_bytes(b"")
    refuses("not a readable PNG", sensor.depth, camera, 0)
    assert cv2.imwrite(str(path), np.zeros((90, 90), np.uint16))
    refuses("90x90 but its image 160x90: register", sensor.depth, camera, 0)


@pytest.mark.parametrize("noise", [0, 0.01])
def test_pixels_between_two_surfaces_are_dropped_and_plain_walls_are_kept(noise: float, tmp_path: Path) -> None:
    """A sensor mixes both depths of an edge; a wall without texture is what it is there for."""
    room = synthetic_recording(cameras=1, held_out=0, frames=1, width=320, height=180)
    (camera,) = room.cameras.values()
    truth = room.depth(camera.name, 0)
    mixed = cv2.blur(truth, (3, 3))
    wrong, right = np.abs(mixed - truth) > 0.05 * truth, np.abs(mixed - truth) < 0.03 * truth
    measured = mixed * (1 + np.random.default_rng(0).normal(0, noise, truth.shape)).astype(np.float32)
    sensor = SimpleNamespace(name="sensor", about="a sensor", depth=lambda camera, frame: measured)
    blank = Frame(0, {camera.name: np.full((180, 320, 3), 128, np.uint8)}, {camera.name: ""})
    depth = DepthOnDisk(sensor, [camera], None, AUTO, tmp_path).depths(blank)[camera.name].depth
    assert wrong.sum() > 300
    assert (depth[wrong] > 0).mean() < 0.02
    assert (depth[right] > 0).mean() > 0.95
    wall = np.full((20, 30), 2, np.float32)
    assert not flying_pixels(wall).any(), "nothing lies beyond the rim of an image"


def test_one_camera_with_a_depth_sensor_has_a_verified_prior(recording: Recording) -> None:
    write_sensor(recording, {"unit": "mm"})
    summary = build_priors(recording, NAMES[:1], recording.path / "priors", PriorSettings())
    assert summary.shares["train0"]["verified"] > 0.5
    assert "sensor depth of train0 in depth/" in str(summary)
    store = PriorStore.open(recording.path / "priors")
    prior, truth = store.prior("train0", 0), recording.depth("train0", 0)
    verified = prior.labels.numpy() == Label.VERIFIED
    assert np.median(np.abs(prior.depth.numpy() - truth)[verified] / truth[verified]) < 1e-3
    record = store.record("train0", 0)
    assert record["stereo"]["matcher"] == "sensor"
    assert record["bounds"] is None


def test_depth_on_disk_is_read_again_where_it_or_its_confidence_changed_and_only_there(recording, monkeypatch) -> None:
    folder, settings = write_sensor(recording, {"unit": "mm"}), PriorSettings(stereo=SENSOR)
    build_priors(recording, NAMES, recording.path / "priors", settings)
    filtered = []
    original = depth_on_disk.filter_sensor
    monkeypatch.setattr(depth_on_disk, "filter_sensor", lambda *a: filtered.append(1) or original(*a))
    assert build_priors(recording, NAMES, recording.path / "priors", settings).built == 0
    assert cv2.imwrite(str(folder / "train0" / "00001.png"), np.full((90, 160), 3000, np.uint16))
    assert build_priors(recording, NAMES, recording.path / "priors", settings).built == 3
    assert len(filtered) == len(NAMES), "one frame"
    write_confidence(recording, np.full((90, 160), 0.5))
    assert build_priors(recording, NAMES, recording.path / "priors", settings).built == 3
    assert build_priors(recording, NAMES, recording.path / "priors", settings).built == 0


def test_the_depth_range_of_the_settings_bounds_depth_on_disk_too(recording: Recording) -> None:
    write_sensor(recording, {"unit": "mm"})
    middle = float(np.median(recording.depth("train0", 0)))
    build_priors(recording, NAMES[:1], recording.path / "p", PriorSettings(variant="mvs", depth_range=(middle, 99.0)))
    depth = PriorStore.open(recording.path / "p").prior("train0", 0).depth.numpy()
    assert depth[depth > 0].min() >= 0.999 * middle


def test_a_workspace_is_found_where_it_usually_lies_or_where_the_settings_say(recording: Recording) -> None:
    assert find_depth_on_disk(recording, NAMES, AUTO) is None
    write_maps(recording, "elsewhere/f1", 1)
    assert find_depth_on_disk(recording, NAMES, AUTO) is None
    assert workspace(recording, "elsewhere/f{frame}").depth(recording.cameras["train0"], 1).any()
    write_maps(recording, "dense", 0)
    assert find_depth_on_disk(replace(recording, frames=(0,)), NAMES, AUTO).about.endswith("dense")
    assert find_depth_on_disk(recording, NAMES, StereoSettings(matcher="patchmatch")) is None


def test_a_workspace_of_one_instant_is_not_the_depth_of_all(recording: Recording) -> None:
    """Many recordings keep the workspace that their initial points come from."""
    write_maps(recording, "colmap", 0)
    assert find_depth_on_disk(recording, NAMES, AUTO) is None
    refuses("at frame 1: name images CAMERA/FRAME.png", workspace(recording).depth, recording.cameras["train0"], 1)
    write_maps(recording, "colmap/00000", 0)
    assert find_depth_on_disk(recording, NAMES, AUTO) is None
    write_maps(recording, "colmap/00001", 1)
    assert find_depth_on_disk(recording, NAMES, AUTO).place == "colmap/{frame:05d}"


def test_images_of_all_frames_may_share_one_workspace(recording: Recording) -> None:
    folder = write_maps(recording, "colmap", 0)
    maps, images = folder / "stereo" / "depth_maps", folder / "sparse" / "images.txt"
    lines = [line for line in images.read_text().splitlines() if line]
    rows = []
    for frame in recording.frames:
        for name, line in zip(NAMES, lines):
            number = len(rows) + 1
            rows.append(f"{number} {line.split(' ', 1)[1].replace(f'{name}.png', f'{name}/{frame:05d}.png')}\n\n")
            (maps / name).mkdir(exist_ok=True)
            write_dense_array(maps / name / f"{frame:05d}.png.photometric.bin", recording.depth(name, frame))
    images.write_text("".join(rows))
    source = workspace(recording)
    for frame in recording.frames:
        np.testing.assert_allclose(source.depth(recording.cameras["train1"], frame), recording.depth("train1", frame))


def test_maps_of_the_geometric_pass_come_first(still: Recording) -> None:
    folder = write_maps(still, "colmap", 0)
    write_dense_array(folder / "stereo" / "depth_maps" / "train0.png.photometric.bin", np.ones((90, 160)))
    source = find_depth_on_disk(still, NAMES, StereoSettings())
    assert np.median(source.depth(still.cameras["train0"], 0)) > 1.5
    (folder / "stereo" / "depth_maps" / "train0.png.geometric.bin").unlink()
    assert (source.depth(still.cameras["train0"], 0) == 1).all()


def test_a_map_of_another_size_and_lens_is_looked_up_ray_by_ray(recording: Recording) -> None:
    camera = replace(recording.cameras["train0"], T_camera_world=np.eye(4))
    wide = replace(camera, width=400, height=250, K=pinhole(150.0, 155.0, 210.0, 120.0))
    found = seen_by(camera, plane_seen_by(wide, (0.2, 0.1, 1), 4), wide.K)
    inside = found > 0
    assert inside.mean() > 0.9
    expected = plane_seen_by(camera, (0.2, 0.1, 1), 4)[inside]
    np.testing.assert_allclose(found[inside], expected, rtol=0.005)  # half a pixel of the map's slope


def test_cameras_of_a_workspace_may_differ_by_a_bundle_adjustment_and_no_more(recording: Recording) -> None:
    cameras = list(recording.cameras.values())

    def scale(**changed: np.ndarray) -> float:
        """With a change of pose of some cameras."""
        poses = {camera.name: changed.get(camera.name, np.eye(4)) @ camera.T_camera_world for camera in cameras}
        return scale_of_world(cameras, poses, Path("w"))

    def turned(degrees: float) -> np.ndarray:
        angle, turn = np.deg2rad(degrees), np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return turn

    moved = np.eye(4)
    moved[:3, 3] = 0.3, -0.2, 0.4
    assert scale(train1=turned(0.5)) == pytest.approx(1, abs=0.01)
    refuses("train0 and train1 are 3.0 degrees off", scale, train1=turned(3.0))
    refuses("another arrangement", scale, train1=moved)
    for count in (1, 3):  # of cameras at one point
        still = [replace(camera, T_camera_world=cameras[0].T_camera_world) for camera in cameras[:count]]
        assert scale_of_world(still, dict.fromkeys(NAMES, cameras[0].T_camera_world), Path("w")) == 1
        refuses("whose scale cannot be known", scale_of_world, still, dict.fromkeys(NAMES, np.eye(4)), Path("w"))


@pytest.mark.parametrize(
    ("file", "text", "other", "more", "message"),
    [
        ("images.txt", "train", "view", "", "has no image of train0, train1, train2 at frame 0: name images"),
        ("cameras.txt", "PINHOLE", "OPENCV", " 0.1 0 0 0", "lens distortion: give the output of `colmap image_und"),
    ],
)
def test_a_workspace_of_other_images_or_lenses_is_refused(still, file, text, other, more, message) -> None:
    path = write_maps(still, "colmap", 0) / "sparse" / file
    path.write_text("".join(f"{line}{more}\n" for line in path.read_text().replace(text, other).splitlines()))
    refuses(message, workspace(still).depth, still.cameras["train0"], 0)


def test_a_workspace_that_saw_other_cameras_is_warned_of(still: Recording, caplog: pytest.LogCaptureFixture) -> None:
    """Held-out cameras must not reach training by way of somebody's depth maps."""
    write_maps(still, "colmap", 0)
    source = find_depth_on_disk(still, NAMES[:2], StereoSettings(matcher="workspace"))
    assert source.depth(still.cameras["train0"], 0).any()
    assert "saw train2.png as well" in caplog.text


def test_priors_from_a_workspace_pass_the_filter_and_are_right_as_is_what_other_cameras_saw(recording) -> None:
    write_maps(recording, "colmap/00000", 0, 3.0)
    write_maps(recording, "colmap/00001", 1, 0.2)
    summary = build_priors(recording, NAMES, recording.path / "priors", PriorSettings(agreement=0.0))
    assert min(share["verified"] for share in summary.shares.values()) > 0.3
    store, verified = PriorStore.open(recording.path / "priors"), {}
    for frame in recording.frames:
        prior, truth = store.prior("train1", frame), recording.depth("train1", frame)
        verified[frame] = prior.verified.numpy()
        np.testing.assert_allclose(prior.depth.numpy()[verified[frame]], truth[verified[frame]], rtol=2e-4)
    survivors = store.record("train1", 0)["stereo"]["survivors"]
    assert 0 < survivors["kept"] <= survivors["confirmed"] < survivors["matched"]


@pytest.mark.parametrize(
    ("matcher", "message"), [("sensor", "has no depth.json"), ("workspace", "say where it is with stereo.folder")]
)
def test_depth_that_is_asked_for_and_absent_is_told(recording: Recording, matcher: str, message: str) -> None:
    with pytest.raises(D2Error, match=message):
        build_priors(recording, NAMES, recording.path / "p", PriorSettings(stereo=StereoSettings(matcher=matcher)))
    assert not (recording.path / "p").exists()


@pytest.mark.parametrize(
    "place",
    ["elsewhere/{number}", "{frame:99999999999d}", "{frame.__class__}", "{frame:.99999999999f}", "{frame", "{}"],
)
def test_braces_never_fill_the_memory_or_look_things_up(place: str, tmp_path: Path) -> None:
    source = WorkspaceDepth(tmp_path, place, [Camera("a", 8, 6, np.eye(3), np.eye(4))], [0])
    refuses("braces around other than frame", source.has_maps, 0)


ONE = "train0"


@pytest.fixture
def one_sensor(tmp_path: Path) -> Recording:
    """One camera with a depth sensor and no monocular maps of its own."""
    room = synthetic_recording(cameras=1, held_out=0, frames=1, width=96, height=54)
    room = replace(room, path=tmp_path, mono_kind=None)
    write_sensor(room, {"scale": 1.0}, 1.0, ".npy")
    return room


def along_the_ray(room: Recording) -> np.ndarray:
    """Distances [H, W] of what its camera sees from the camera's centre."""
    camera = room.cameras[ONE]
    x, y = (np.arange(size) + 0.5 for size in (camera.width, camera.height))
    u, v = (x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1]
    return room.depth(ONE, 0) * np.sqrt(1 + u**2 + v[:, None] ** 2)


def write_confidence(room: Recording, values: np.ndarray, suffix: str = ".npy") -> None:
    folder = room.path / "depth_confidence" / ONE
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"00000{suffix}"
    assert cv2.imwrite(str(path), values) if suffix == ".png" else np.save(path, values) is None


def prior_of(room: Recording, settings: PriorSettings | None = None) -> PriorStore:
    build_priors(room, [ONE], room.path / "store", settings or PriorSettings(stereo=SENSOR))
    return PriorStore.open(room.path / "store")


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_a_sensor_is_as_sure_as_it_says_and_a_pixel_it_does_not_trust_is_no_depth(one_sensor, suffix) -> None:
    before = prior_of(one_sensor).prior(ONE, 0)
    sure = np.ones((54, 96))
    sure[:, 30:60], sure[:, 60:] = 0.5, 0
    write_confidence(one_sensor, np.rint(sure * 65535).astype(np.uint16) if suffix == ".png" else sure, suffix)
    after = prior_of(one_sensor).prior(ONE, 0)
    kept = (before.depth > 0).numpy() & (sure > 0)
    assert kept.any()
    assert (after.depth.numpy()[:, 60:] == 0).all()
    assert (after.labels.numpy()[:, 60:] == Label.EMPTY).all()
    both = kept & (after.depth > 0).numpy()
    np.testing.assert_allclose(after.depth.numpy()[both], before.depth.numpy()[both], rtol=1e-3)
    np.testing.assert_allclose(after.sigma.numpy()[both], before.sigma.numpy()[both] / sure[both], rtol=0.05)


@pytest.mark.parametrize("wrong", [-0.1, 1.5, np.nan])
def test_a_confidence_outside_of_0_to_1_is_refused_with_its_file(one_sensor: Recording, wrong: float) -> None:
    write_confidence(one_sensor, np.full((54, 96), wrong))
    refuses(r"depth_confidence.*00000.npy .*a confidence is in 0..1", prior_of, one_sensor)


def test_distances_along_the_ray_become_planar_depth_once(one_sensor: Recording) -> None:
    truth, distance = one_sensor.depth(ONE, 0), along_the_ray(one_sensor)
    assert np.abs(distance / truth - 1).max() > 0.05
    before = prior_of(one_sensor).prior(ONE, 0).depth
    write_sensor(showing(one_sensor, {"depth": lambda *_: distance}), {"scale": 1.0, "along": "ray"}, 1.0, ".npy")
    np.testing.assert_allclose(prior_of(one_sensor).prior(ONE, 0).depth, before, rtol=1e-3)


@pytest.mark.parametrize("along", ["ray", "z"])
def test_metric_maps_of_one_camera_are_its_prior_and_may_measure_along_the_ray(tmp_path: Path, along: str) -> None:
    room = synthetic_recording(cameras=1, held_out=0, frames=1, width=96, height=54)
    truth = room.depth(ONE, 0)
    mono = along_the_ray(room).astype(np.float32) if along == "ray" else truth
    metric = showing(room, {"mono": lambda *_: mono}, path=tmp_path, mono_kind="metric")
    found = prior_of(metric, PriorSettings(mono_along=along, hanging_limit=0)).prior(ONE, 0)
    np.testing.assert_allclose(found.depth, truth, rtol=1e-3)
    assert (found.labels == Label.MONO).all()


def test_relative_maps_may_not_measure_along_the_ray(one_sensor: Recording) -> None:
    relative = replace(one_sensor, mono_kind="relative")
    refuses("mono_along = ray needs metric maps", prior_of, relative, PriorSettings(mono_along="ray"))

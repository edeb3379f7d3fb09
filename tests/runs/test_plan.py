"""What a scene does not need is left out, with the measurement that says so."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import showing, world_points
from refusals import refuses

from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.priors.stereo import matched_depth
from d2_plugin.protocol import Label
from d2_plugin.recordings import Camera, Recording, open_recording, select_frames
from d2_plugin.recordings.cameras.camera import pinhole, rigid
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.overlap import measure_overlap, measure_texture
from d2_plugin.runs.plan import changed_share, plan_scene
from d2_plugin.runs.run import Run, build_priors_for
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings
from d2_plugin.store.store import PriorStore


@pytest.fixture(scope="module")
def moving():
    return synthetic_recording(cameras=3, frames=4, width=96, height=54)


PAIR = ["train0", "train1"]


@pytest.mark.parametrize(
    ("frames", "cameras", "maps", "used", "left_out"),
    [
        (None, PAIR, "maps", ("temporal", "stereo", "monocular", "verification"), ()),
        (None, PAIR[:1], "maps", ("temporal",), ("stereo", "verification")),
        (None, PAIR, None, ("stereo",), ("monocular", "verification")),
        ([2], PAIR, "maps", ("stereo",), ("temporal",)),
    ],
    ids=["all", "one camera", "no monocular depth", "one instant"],
)
def test_what_a_scene_does_not_have_is_left_out(moving, frames, cameras, maps, used, left_out) -> None:
    plan = plan_scene(select_frames(moving, frames) if frames else moving, cameras, maps)
    assert all(plan.uses(name) for name in used)
    assert not any(plan.uses(name) for name in left_out)
    assert frames is None or plan.as_dict()["temporal"] == {"use": False, "reason": "one instant"}
    assert len(cameras) > 1 or plan.as_dict()["stereo"] == {"use": False, "reason": "one training camera"}


def test_depth_is_emulated_where_no_network_takes_the_place_of_emulated_maps(moving, tmp_path: Path) -> None:
    save_recording(moving, tmp_path / "room")
    settings = RunSettings(str(tmp_path / "room"), PAIR)
    assert Scene.open(settings).plan.emulated
    assert not Scene.open(replace(settings, mono_onnx="network.onnx", mono_kind="relative")).plan.emulated


@pytest.mark.parametrize(
    ("iterations", "tables", "built"),
    [(199, {}, False), (200, {}, True), (499, {}, True), (500, {}, True), (199, {"motion": {}}, True)],
)
def test_long_runs_and_users_who_say_so_get_what_lies_between(
    moving, tmp_path, monkeypatch, iterations, tables, built
) -> None:
    def stop(*_: object, between: bool, on_view: object) -> None:
        raise D2Error(f"between: {between}")

    monkeypatch.setattr("d2_plugin.runs.run.build_priors_for", stop)
    room = save_recording(moving, tmp_path / "room")
    run = Run(RunSettings(str(room), PAIR, iterations=iterations, overrides=tables), tmp_path / "run")
    for name, left_out in (("motion", not built), ("parallax", iterations < 500)):
        assert any(f"[{name}] brings it back" in note for note in run.scene.recording.notes) == left_out
    refuses(f"between: {built}", run.prepare)


def test_no_motion_leaves_the_temporal_dimension_out() -> None:
    still = synthetic_recording(cameras=2, frames=4, width=96, height=54, moving=False)
    assert not plan_scene(still, PAIR, "maps").uses("temporal")
    assert changed_share(still, "train0") == 0


def test_a_user_may_decide_otherwise_and_the_plan_says_so(moving) -> None:
    plan = plan_scene(moving, PAIR, "maps").override(temporal=False, stereo=None)
    assert not plan.uses("temporal")
    assert plan.uses("stereo")
    assert "overridden by the user (measured: motion" in plan.as_dict()["temporal"]["reason"]


def test_stereo_left_out_by_the_user_leaves_out_what_follows_from_it(moving) -> None:
    plan = plan_scene(moving, PAIR, "relative maps").override(stereo=False)
    assert [plan.uses(name) for name in ("stereo", "verification", "monocular")] == [False] * 3
    assert "no geometric depth gives their scale" in plan.as_dict()["monocular"]["reason"]
    metric = plan_scene(replace(moving, mono_kind="metric"), PAIR, "metric maps").override(stereo=False)
    assert [metric.uses(name) for name in ("stereo", "verification", "monocular")] == [False, False, True]


def test_what_cannot_be_is_not_overridden(moving) -> None:
    alone = plan_scene(moving, ["train0"], None)
    refuses(r"\[plan\] stereo = true, but one training camera: it takes a second", alone.override, stereo=True)
    twice = replace(moving, cameras=dict.fromkeys(("train0", "train1"), moving.cameras["train0"]))
    plan = plan_scene(twice, PAIR, None)
    refuses("all training cameras stand at one point: it takes cameras that stand apart", plan.override, stereo=True)


def test_training_cameras_at_one_point_are_named_once(moving, tmp_path: Path) -> None:
    first = moving.cameras["train0"]
    turned = rigid(rotation_of_vector(np.array([0, 0.05, 0])), np.zeros(3)) @ first.T_camera_world
    same = {"train1": replace(first, name="train1", T_camera_world=turned)}
    save_recording(replace(moving, cameras={**moving.cameras, **same}), tmp_path / "room")
    notes = [
        [note for note in Scene.open(RunSettings(str(tmp_path / "room"), names)).recording.notes if "point" in note]
        for names in (("train0", "train1", "train2"), ("train0", "train2"), ("train0", "train1"))
    ]
    said = "cameras train0 and train1 stand at one point and give no depth together: correct their poses if they do not"
    assert notes == [[said], [], []], "a held-out one needs none, and of all of them the plan says it"


def camera(name: str, x: float = 0.0, turn: float = 0.0, near_far: tuple[float, float] | None = None) -> Camera:
    """At (x, 0, 0), turned to the right by `turn` degrees; 100 pixels wide, 53 degrees."""
    rotation = rotation_of_vector(np.array([0, -np.deg2rad(turn), 0]))
    return Camera(name, 100, 80, pinhole(100, 100, 50, 40), rigid(rotation, -rotation @ [x, 0, 0]), near_far)


AT_TWO = (1.999, 2.001)


def test_overlap_is_the_share_of_the_image_that_another_camera_sees() -> None:
    pair = [camera("a", near_far=AT_TWO), camera("b", 0.5, near_far=AT_TWO)]  # a shift by 25 of 100 pixels
    found = measure_overlap(pair, StereoSettings())
    assert found.depth_known
    assert found.shares == pytest.approx((0.75, 0.75))
    assert found.angles == pytest.approx((13.5, 13.5), abs=0.5)  # 14 in the middle, less towards the sides
    assert measure_overlap(pair, StereoSettings(), depth_range=(0.999, 1.001)).shares == pytest.approx((0.5, 0.5))


def test_angles_that_cannot_be_matched_are_no_overlap() -> None:
    across = [camera("a", -2, 45, (2.8, 2.9)), camera("b", 2, -45, (2.8, 2.9))]  # both look at (0, 0, 2)
    assert max(measure_overlap(across, StereoSettings()).shares) == 0
    assert min(measure_overlap(across, StereoSettings(max_angle=120.0)).shares) > 0.3
    still = [camera("a", near_far=AT_TWO), camera("b", 1e-3, near_far=AT_TWO)]
    assert max(measure_overlap(still, StereoSettings()).shares) == 0


def rig(recording: Recording, *cameras: Camera) -> Recording:
    """The recording with other cameras for train0 and train1; its images stay."""
    sized = [replace(c, width=96, height=54, K=pinhole(96, 96, 48, 27)) for c in cameras]
    return replace(recording, cameras={name: replace(c, name=name) for name, c in zip(("train0", "train1"), sized)})


def test_cameras_that_share_nothing_have_no_stereo_and_the_reason_says_how_little(moving) -> None:
    plan = plan_scene(rig(moving, camera("a", 0, -90), camera("b", 0.5, 90)), PAIR, "relative maps")
    assert not plan.uses("stereo")
    assert plan.as_dict()["stereo"]["reason"].startswith("no overlap: 2 training cameras, at most 0% of each image")
    assert not plan.uses("verification")
    assert plan.override(stereo=True).uses("verification")


def test_images_without_texture_have_no_stereo_and_the_reason_says_so(moving) -> None:
    plain = showing(moving, {"image": lambda *view: np.full_like(moving.image(*view), 90)})
    assert measure_texture(plain, ["train0"]) == (0,)
    plan = plan_scene(plain, PAIR, "maps")
    assert not plan.uses("stereo")
    assert plan.as_dict()["stereo"]["reason"].startswith("no texture: 2 training cameras")
    assert plan.as_dict()["stereo"]["reason"].endswith("0% textured")


def test_a_colmap_model_brings_the_points_that_tell_the_depths(moving, tmp_path: Path) -> None:
    undeclared = {name: replace(c, near_far=None) for name, c in moving.cameras.items()}
    still = replace(select_frames(moving, [0]), cameras=undeclared)
    points = world_points(still.cameras["train0"], still.depth("train0", 0))[::37]
    cloud = PointCloud(points, np.full(points.shape, 0.5))
    model = open_recording(export_recording(still, "colmap", tmp_path / "model", cloud=cloud))
    assert "depths unknown" not in plan_scene(model, PAIR, None).as_dict()["stereo"]["reason"]
    unknown = plan_scene(still, PAIR, None)
    assert unknown.uses("stereo")
    assert "depths unknown" in unknown.as_dict()["stereo"]["reason"]


def with_sensor(recording: Recording, folder: Path, *cameras: str) -> Recording:
    """The recording on disk, with depth of a sensor beside the images of `cameras`."""
    path = save_recording(recording, folder / "scene")
    shutil.rmtree(path / "depth")
    for name in cameras:
        (path / "depth" / name).mkdir(parents=True)
        for frame in recording.frames:
            np.save(path / "depth" / name / f"{frame:05d}.npy", recording.depth(name, frame))
    (path / "depth" / "depth.json").write_text('{"unit": "m"}')
    return open_recording(path)


def test_a_sensor_is_the_geometric_source_of_one_camera(moving, tmp_path: Path) -> None:
    plan = plan_scene(with_sensor(moving, tmp_path, "train0"), ["train0"], "relative maps")
    assert plan.as_dict()["sensor"] == {"use": True, "reason": "sensor depth of train0 in depth/"}
    assert [plan.uses(name) for name in ("stereo", "monocular", "verification")] == [False, True, True]
    assert plan.obeyed_by(PriorSettings()) == PriorSettings()
    refuses(r"the sensor is taken first: choose a matcher", plan.override, stereo=True)


def test_a_sensor_beside_one_of_two_cameras_leaves_stereo(moving, tmp_path: Path) -> None:
    recording = with_sensor(moving, tmp_path, "train0")
    plan = plan_scene(recording, PAIR, None)
    assert [plan.uses(name) for name in ("sensor", "stereo")] == [False, True]
    assert "does not serve every training camera" in plan.as_dict()["sensor"]["reason"]
    assert plan_scene(recording, PAIR, None, PriorSettings(stereo=StereoSettings(matcher="patchmatch"))).uses("stereo")


def test_a_scene_before_the_near_plane_is_refused(moving, tmp_path: Path) -> None:
    """In kilometres, say: no Gaussian would be drawn."""
    poses = {name: moving.cameras[name].T_camera_world * [[1, 1, 1, 1e-3]] for name in PAIR}
    tiny = [replace(moving.cameras[name], T_camera_world=pose, near_far=None) for name, pose in poses.items()]
    for one in tiny:
        one.T_camera_world[3, 3] = 1
    path = save_recording(rig(select_frames(moving, [0]), *tiny), tmp_path / "scene")
    settings = RunSettings(str(path), tuple(PAIR), iterations=2, hooks=())
    refuses("set `near = 0.0", Run(replace(settings, hooks=("densify",)), tmp_path / "run").train)
    assert not (tmp_path / "run" / "priors").exists(), "refused before the prior is built"
    Run(replace(settings, overrides={"backbone": {"raster": {"near": 2e-4}}}), tmp_path / "drawn").train()


def test_no_stereo_reaches_the_priors(moving, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is matched, and monocular depth stands alone where its scale is known."""
    apart = replace(select_frames(moving, [0, 1]), mono_kind="metric")
    path = save_recording(rig(apart, camera("a", 0, -90), camera("b", 0.5, 90)), tmp_path / "scene")
    for name in ("train0", "train1"):
        for frame in (0, 1):
            np.save(path / "mono" / name / f"{frame:05d}.npy", moving.depth(name, frame))
    monkeypatch.setattr(matched_depth, "geometric_depth", lambda *_: pytest.fail("something was matched"))
    scene = Scene.open(RunSettings(str(path), ("train0", "train1")))
    assert [scene.plan.uses(name) for name in ("stereo", "monocular", "verification")] == [False, True, False]
    summary = build_priors_for(scene, np.zeros((0, 3)), tmp_path / "priors")
    assert any("nothing matched" in note for note in summary.notes)
    prior = PriorStore.open(tmp_path / "priors").prior("train0", 0)
    assert set(np.unique(prior.labels)) <= {Label.MONO, Label.EMPTY}
    assert prior.support.numpy().mean() > 0.8


@pytest.mark.parametrize(
    ("name", "cameras", "frames", "moves"),
    [
        ("studio", "00 02 05 07", None, True),
        ("plaza", "02 05", None, True),
        ("n3dv_sear_steak_t0", "cam03 cam05 cam08 cam14", None, False),
        ("pose2sim_single", "cam01 cam02 cam03 cam04", [0, 20, 40], True),
    ],
)
def test_real_recordings_keep_stereo_and_time_where_something_moves(shared_data, name, cameras, frames, moves) -> None:
    plan = plan_scene(open_recording(shared_data(name), frames=frames), cameras.split(), None)
    assert plan.uses("stereo")
    assert plan.uses("temporal") == moves
    assert "textured" in plan.as_dict()["stereo"]["reason"]

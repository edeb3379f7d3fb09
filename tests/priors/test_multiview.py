"""Depth of all views from one network: read as its exporters write it, scaled, believed as far as evidence goes."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny_onnx
from hypothesis import given
from hypothesis import strategies as st
from prior_cases import camera_at, contents, showing, write_multiview
from refusals import refuses

from benchmarks.emulated_multiview import emulated_multiview
from d2_plugin.priors.build import PriorSettings, build_priors
from d2_plugin.priors.declared_error import held_against_truth
from d2_plugin.priors.frame import Frame
from d2_plugin.priors.multiview.fit import Vote, fitted, voted
from d2_plugin.priors.multiview.moving import follow_images
from d2_plugin.priors.multiview.predicted import prediction_files, read_prediction, understood
from d2_plugin.priors.multiview.scale import MOST_POWER, pose_scale, power_of, world_scale
from d2_plugin.priors.multiview.source import MultiviewMap, MultiviewSource
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.plan import plan_scene
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

NAMES = ["train0", "train1", "train2"]
SETTINGS = PriorSettings(stereo=StereoSettings(matcher="patchmatch"))
ALONE = PriorSettings(stereo=StereoSettings(matcher="none"))


@pytest.fixture(scope="module")
def room() -> Recording:
    return synthetic_recording(cameras=3, held_out=0, frames=2, width=160, height=90, arc_degrees=80)


@pytest.fixture(scope="module")
def maps(room: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pose-free predictions, each instant with a similarity of its own."""
    return write_multiview(room, NAMES, tmp_path_factory.mktemp("multiview") / "maps")


@pytest.fixture(scope="module")
def without(room: Recording, tmp_path_factory: pytest.TempPathFactory) -> PriorStore:
    """The prior of stereo and monocular maps."""
    return build(room, tmp_path_factory.mktemp("without"), SETTINGS, None)


@pytest.fixture(scope="module")
def good(room: Recording, without: PriorStore, maps: Path, tmp_path_factory: pytest.TempPathFactory) -> PriorStore:
    """The prior of stereo, monocular maps and these."""
    return build(room, tmp_path_factory.mktemp("good") / "prior", SETTINGS, maps, without)


def build(
    room: Recording, path: Path, settings: PriorSettings, maps: Path | None, begun: PriorStore | None = None
) -> PriorStore:
    """A store of its own; the views are not matched again where another one is `begun`."""
    if begun is not None:
        shutil.copytree(begun.path, path)
    build_priors(room, NAMES, path, replace(settings, multiview=maps and str(maps)))
    return PriorStore.open(path)


def median_error(room: Recording, store: PriorStore, *labels: Label) -> float:
    """At the last instant of the recording."""
    errors = []
    for camera in NAMES:
        truth, prior = room.depth(camera, room.frames[-1]), store.prior(camera, room.frames[-1])
        mask = np.isin(prior.labels.numpy(), labels)
        errors.append(np.abs(np.log(prior.depth.numpy()[mask] / truth[mask])))
    return float(np.median(np.concatenate(errors)))


def test_files_are_read_as_the_exporters_name_their_arrays(room: Recording, tmp_path: Path) -> None:
    """Also where their scripts put them, below a folder of the instant; what a file holds besides is passed over."""
    arrays = emulated_multiview([room.depth(name, 0) for name in NAMES], list(room.cameras.values()), 0, posed=False)
    inverted = np.linalg.inv(np.concatenate([arrays["extrinsics"], [[[0, 0, 0, 1]]] * 3], axis=1))
    mask = arrays["conf"] > 1.5
    exports = {
        "3/exports/npz/results.npz": {**arrays, "image": np.zeros((3, 4, 4, 3), np.uint8)},
        "4/predictions.npz": {
            "depth": arrays["depth"][..., None],
            "depth_conf": arrays["conf"],
            "extrinsic": arrays["extrinsics"],
            "intrinsic": arrays["intrinsics"],
            "pose_enc_list": np.array(None),
        },
        "5/predictions.npz": {
            "depth": arrays["depth"][..., None],
            "conf": arrays["conf"],
            "extrinsic": inverted,
            "intrinsic": arrays["intrinsics"],
            "final_mask": mask,
        },
    }
    for place, content in exports.items():
        (tmp_path / place).parent.mkdir(parents=True)
        np.savez(tmp_path / place, **content)
    files = prediction_files(tmp_path)
    anything, vggt, map_anything = (read_prediction(files[number], (3,)) for number in (3, 4, 5))
    for found, same in zip(anything, vggt, strict=True):
        np.testing.assert_array_equal(found, same)
    np.testing.assert_allclose(map_anything.poses, anything.poses, atol=1e-5)
    np.testing.assert_array_equal(np.isnan(map_anything.depth), ~mask)
    np.testing.assert_array_equal(map_anything.confidence[mask], arrays["conf"][mask])


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({}, "no array 'depth'"),
        ({"depth": np.ones((4, 6, 8))}, "of 3 views"),
        ({"depth": np.ones((6, 8))}, "of 3 views"),
        ({"depth": np.ones((3, 6, 8)), "conf": np.ones((3, 5, 8))}, r"expected \[3, 6, 8\]"),
        ({"depth": np.ones((3, 6, 8)), "extrinsics": np.ones((2, 3, 4))}, "poses"),
        ({"depth": np.ones((3, 6, 8)), "intrinsics": np.ones((3, 4))}, "intrinsics"),
    ],
)
def test_arrays_that_do_not_belong_together_are_one_sentence(arrays: dict, words: str) -> None:
    refuses(words, understood, arrays, "x.npz", (3,))


def test_files_that_hold_no_prediction_are_one_sentence(tmp_path: Path) -> None:
    refuses("no multi-view maps", prediction_files, tmp_path / "nowhere")
    refuses("neither", prediction_files, tmp_path)
    garbage = tmp_path / "00001.npz"
    garbage.write_bytes(b"PK garbage")
    refuses("export the prediction again", read_prediction, garbage, (3,))
    np.savez(garbage, depth=np.array(["text"]))
    refuses("plain numbers", read_prediction, garbage, (3,))
    np.savez(garbage, depth=np.full((3, 4, 5), 1e300), conf=np.full((3, 4, 5), -1.0))
    assert np.isnan(read_prediction(garbage, (3,)).depth).all()


@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.floats(-6, 6), st.booleans())
def test_poses_have_the_scale_of_the_similarity_also_for_two_cameras_and_on_a_line(seed, count, power, line) -> None:
    rng = np.random.default_rng(seed)
    rotations = np.stack([rotation_of_vector(rng.normal(0, 1, 3)) for _ in range(count)])
    centres = np.outer(rng.permutation(count), rng.normal(0, 1, 3)) if line else rng.normal(0, 1, (count, 3))
    turn, place, scale = rotation_of_vector(rng.normal(0, 1, 3)), rng.normal(0, 5, 3), 10.0**power
    theirs = rotations @ turn
    moved = (centres - place) @ turn / scale
    poses = np.concatenate([theirs, -theirs @ moved[..., None]], axis=2)
    calibrated = np.concatenate([rotations, -rotations @ centres[..., None]], axis=2)
    cameras = [Camera("", 8, 6, np.eye(3), np.vstack([pose, [0, 0, 0, 1]])) for pose in calibrated]
    assert pose_scale(poses, cameras) == pytest.approx(scale, rel=1e-6)


def test_maps_tell_their_scale_without_poses_and_overrule_wrong_ones(room: Recording) -> None:
    depth = {name: room.depth(name, 0) * np.float32(0.01) for name in NAMES}
    wrong = np.stack([camera.T_camera_world[:3] for camera in room.cameras.values()])
    right = wrong * [1, 1, 1, 0.01]
    one_point, unknown = np.tile(np.eye(3, 4), (3, 1, 1)), np.full((3, 3, 4), np.nan)
    for poses in (None, wrong, one_point, unknown):
        assert world_scale(depth, room.cameras, poses) == pytest.approx(100, rel=0.05)
    assert world_scale(depth, room.cameras, right) == pytest.approx(100, rel=1e-6)
    assert np.isnan(world_scale({"train0": depth["train0"]}, {"train0": room.cameras["train0"]}, None))
    back_to_back = {name: camera_at((i, 0, 0), i * np.pi, size=(160, 90)) for i, name in enumerate(NAMES[:2])}
    for one in (depth["train0"], np.full_like(depth["train0"], np.nan)):
        assert np.isnan(world_scale({"train0": one, "train1": depth["train1"]}, back_to_back, None))


@pytest.mark.parametrize(("unit", "power"), [(1.0, 1.0), (1e-6, 0.5), (1e6, 1.5), (1.0, -1.0), (1.0, 5.0)])
def test_confidence_counts_by_how_errors_follow_it_in_any_unit(unit: float, power: float) -> None:
    """An inverted one counts for nothing, and none for more than `MOST_POWER`."""
    rng = np.random.default_rng(0)
    confidence = unit * np.exp(rng.normal(0, 1, 5000))
    error = np.abs(rng.normal(0, 1, 5000)) * (confidence / unit) ** -power
    assert power_of(confidence, error) == pytest.approx(np.clip(power, 0, MOST_POWER), abs=0.15)
    assert power_of(np.full(100, unit), error[:100]) == 0
    assert power_of(np.zeros(0), np.zeros(0)) == 0


def test_a_good_source_makes_what_stereo_does_not_know_nearer_to_the_truth_and_declares_it(room, good, without) -> None:
    unmeasured = Label.MONO, Label.AGREED
    assert median_error(room, good, *unmeasured) < 0.7 * median_error(room, without, *unmeasured)
    record = good.record("train0", 1)
    assert record["multiview"]["alignment"]["status"] == "ok"
    assert record["multiview"]["alignment"]["scale"] == pytest.approx(1, abs=0.1), "poses and what stands still gave it"
    for label, errors in held_against_truth(good, room).labels.items():
        assert errors.share < 0.05 or (errors.within > 0.55 and errors.within_two > 0.85), label


def test_where_nothing_is_matched_the_views_that_agree_give_a_prior(room: Recording, maps: Path, tmp_path) -> None:
    store = build(showing(room, {}, mono_kind=None), tmp_path, ALONE, maps)
    labels = np.stack([store.prior(name, 1).labels.numpy() for name in NAMES])
    assert (labels == Label.AGREED).mean() > 0.05
    assert np.isin(labels, (Label.AGREED, Label.MONO)).mean() > 0.6
    assert median_error(room, store, Label.AGREED, Label.MONO) < 0.05
    for label, errors in held_against_truth(store, room).labels.items():
        assert errors.within_two > 0.85, label


def spoilt_noise(arrays: dict[str, np.ndarray], frame: int) -> None:
    arrays["depth"] *= np.exp(np.random.default_rng(frame).normal(0, 0.6, arrays["depth"].shape)).astype(np.float32)


def spoilt_views(arrays: dict[str, np.ndarray], frame: int) -> None:
    arrays["depth"] = arrays["depth"][::-1, ::-1].copy()


def spoilt_confidence(arrays: dict[str, np.ndarray], frame: int) -> None:
    arrays["conf"][:] = 0
    arrays["depth"][1:] = np.inf


@pytest.mark.parametrize("spoilt", [spoilt_noise, spoilt_views, spoilt_confidence])
def test_a_source_that_shows_nothing_leaves_the_prior_as_it_is_or_nearly(room, without, tmp_path, spoilt) -> None:
    instant = replace(room, frames=(0,))
    maps = write_multiview(instant, NAMES, tmp_path / "maps", turned=spoilt)
    store = build(instant, tmp_path / "prior", SETTINGS, maps, without)
    found, expected = (np.stack([each.prior(name, 0).verified for name in NAMES]) for each in (store, without))
    assert (found & expected).sum() > 0.99 * expected.sum()
    every = Label.MONO, Label.AGREED
    assert median_error(instant, store, *every) < 1.03 * median_error(instant, without, *every)


@pytest.mark.parametrize("moved_on", [0, 1])
def test_maps_of_other_instants_say_nothing_of_what_moves(tmp_path: Path, moved_on: int, caplog) -> None:
    """Files with the numbers of other frames, here the next: their still part is used alone."""
    long = synthetic_recording(cameras=3, held_out=0, frames=5, width=96, height=54, fps=1.0)
    maps = write_multiview(long, NAMES, tmp_path / "right")
    renamed = tmp_path / "renamed"
    renamed.mkdir()
    for frame in long.frames:
        other = long.frames[(frame + moved_on) % len(long.frames)]
        shutil.copyfile(maps / f"{other:05d}.npz", renamed / f"{frame:05d}.npz")
    settings, read = PriorSettings(multiview=str(renamed)), partial(Frame.read, long, NAMES)
    source = MultiviewSource(long, NAMES, settings, tmp_path / "cache", read)
    views = [(frame, *view) for frame in long.frames for view in source.views(read(frame)).items()]
    error = np.stack([np.log(map_.depth / long.depth(name, frame)) for frame, name, map_ in views])
    unknown = np.stack([map_.confidence for _, _, map_ in views]) == 0
    wrong = np.abs(error - np.median(error)) > 0.3
    assert ("what moves in the maps is not what moves in the images" in caplog.text) == (moved_on > 0)
    assert unknown.mean() < 0.2
    assert not unknown.any() if moved_on == 0 else unknown[wrong].mean() > 0.7


def test_where_nothing_moves_nothing_is_held_against_the_maps() -> None:
    """Nor where all changes in its place, nor where images flicker and no map shows it; noise in each map is."""
    rng = np.random.default_rng(0)
    nothing, all_ = np.zeros((5, 1, 40, 40), bool), np.ones((5, 1, 40, 40), bool)
    noise = rng.random((2, 5, 1, 40, 40)) < 0.2
    assert follow_images(nothing, nothing)
    assert follow_images(noise[0], nothing)
    assert follow_images(noise[0], noise[0])
    assert not follow_images(noise[0], noise[1])
    assert follow_images(all_, all_)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_unit_of_the_depth_changes_nothing(room, good, without, tmp_path, factor) -> None:
    """Nor does that of the poses, nor of the confidence."""

    def scaled(arrays: dict[str, np.ndarray], frame: int) -> None:
        arrays["depth"] *= np.float32(factor)
        arrays["conf"] *= np.float32(factor)
        arrays["extrinsics"][..., 3] *= np.float32(factor)

    maps = write_multiview(room, NAMES, tmp_path / "maps", turned=scaled)
    other = build(room, tmp_path / "prior", SETTINGS, maps, without)
    for name in NAMES:
        one, two = (store.prior(name, 1) for store in (good, other))
        same = (one.labels == two.labels).numpy()
        assert same.mean() > 0.995
        np.testing.assert_allclose(one.depth.numpy()[same], two.depth.numpy()[same], rtol=3e-3)


@pytest.mark.parametrize("turned", [None, spoilt_confidence])
def test_one_view_alone_has_no_scale_and_is_refused(room: Recording, tmp_path: Path, turned: Callable | None) -> None:
    room = replace(room, frames=(0,))
    maps = write_multiview(room, NAMES[:1], tmp_path / "maps", turned=turned)
    settings = replace(ALONE, multiview=str(maps))
    summary = build_priors(showing(room, {}, mono_kind=None), NAMES[:1], tmp_path / "prior", settings)
    assert not summary.usable
    assert "surfaces" in summary.reasons()


def test_stereo_of_one_thing_does_not_scale_an_instant_and_that_of_the_scene_does(room: Recording) -> None:
    """Neither view by view nor for all; metric maps stay as they are."""
    truth = {name: room.depth(name, 0) for name in NAMES}
    maps = {name: MultiviewMap(depth, np.ones_like(depth)) for name, depth in truth.items()}
    thing = np.zeros_like(truth["train0"], bool)
    thing[40:55, 40:70] = True
    for kind in ("shared", "view", "metric"):
        settings = replace(SETTINGS, multiview_scale=kind)
        for known, scale in ((thing, 1.0), (~thing, 1.0 if kind == "metric" else 1.1)):
            anchors = {name: np.where(known, np.float32(1.1) * depth, 0) for name, depth in truth.items()}
            found = fitted(maps, anchors, room.cameras, settings)
            assert [each.alignment.scale for each in found.values()] == pytest.approx([scale] * 3, rel=1e-5)


def test_only_what_changed_is_built_again(room: Recording, without: PriorStore, tmp_path: Path) -> None:
    """Of metric maps; the scale of others depends on the instants at which it is measured."""
    settings = replace(SETTINGS, multiview_scale="metric")
    maps = write_multiview(room, NAMES, tmp_path / "maps", posed=True)
    store = build(room, tmp_path / "prior", settings, maps, without)
    before = contents(store.path)

    def changed(arrays: dict[str, np.ndarray], frame: int) -> None:
        arrays["depth"][:, :5] *= np.float32(1.5 if frame == 1 else 1)

    for place, turned, built in (("same", None, 0), ("other", changed, 3)):
        maps = write_multiview(room, NAMES, tmp_path / place, posed=True, turned=turned)
        assert build_priors(room, NAMES, tmp_path / "prior", replace(settings, multiview=str(maps))).built == built
        assert (contents(store.path) == before) == (built == 0)


def test_a_frame_that_the_network_did_not_see_has_the_prior_of_the_other_sources(room, without, tmp_path) -> None:
    maps = write_multiview(replace(room, frames=(0,)), NAMES, tmp_path / "maps")
    store = build(room, tmp_path / "prior", SETTINGS, maps, without)
    for one, two in zip(store.prior("train1", 1)[:4], without.prior("train1", 1)[:4], strict=True):
        np.testing.assert_array_equal(one.numpy(), two.numpy())


def test_frames_that_are_not_there_and_views_in_another_order_are_named(room, maps, tmp_path, caplog) -> None:
    other = write_multiview(room, ["train2", "train0", "train1"], tmp_path / "maps")
    source = partial(MultiviewSource, cache=tmp_path / "cache", read=partial(Frame.read, room, NAMES))
    for folder, named in ((maps, False), (other, True)):
        source(room, NAMES, replace(ALONE, multiview=str(folder))).views(Frame.read(room, NAMES, 0))
        assert ("another order, say so in multiview.json" in caplog.text) == named
    (other / "00000.npz").unlink()
    assert "lacks" not in caplog.text
    source(room, NAMES, replace(ALONE, multiview=str(other)))
    assert "lacks 1 of 2 frames, frame 0 first" in caplog.text
    (other / "00001.npz").rename(other / "00007.npz")
    refuses(
        "frames 7 to 7 and none of the recording's, 0 to 1", source, room, NAMES, replace(ALONE, multiview=str(other))
    )


def test_maps_without_any_depth_or_confidence_are_named(room: Recording, tmp_path: Path, caplog) -> None:
    def unsure(arrays: dict[str, np.ndarray], frame: int) -> None:
        arrays["conf"] = -arrays["conf"]

    maps = write_multiview(room, NAMES, tmp_path / "maps", turned=unsure)
    read = partial(Frame.read, room, NAMES)
    MultiviewSource(room, NAMES, replace(ALONE, multiview=str(maps)), tmp_path / "cache", read).views(read(0))
    assert "frames 0, 1 have no pixel with depth and confidence above 0" in caplog.text


def test_the_cameras_that_the_network_saw_may_be_more_and_in_another_order(room, maps, tmp_path) -> None:
    other = write_multiview(room, ["train2", "train0", "train1"], tmp_path / "maps", posed=True)
    (other / "multiview.json").write_text('{"cameras": ["train2", "train0", "train1"], "emulated": true}')
    settings = replace(ALONE, multiview=str(other))
    few = replace(room, cameras={name: room.cameras[name] for name in NAMES[:2]})
    build_priors(few, NAMES[:2], tmp_path / "prior", settings)
    store = PriorStore.open(tmp_path / "prior")
    truth, prior = room.depth("train0", 0), store.prior("train0", 0)
    known = (prior.depth > 0).numpy()
    assert np.median(np.abs(np.log(prior.depth.numpy()[known] / truth[known]))) < 0.05
    assert "emulated" in store.record("train0", 0)["several"]
    (other / "multiview.json").write_text('{"cameras": ["train2", "trian0", "train1"]}')
    refuses("lacks camera 'train0', it has", build_priors, few, NAMES[:2], tmp_path / "prior", settings)


def test_a_network_of_so_many_views_refuses_another_number_and_runs_once_a_frame(room, tmp_path, monkeypatch) -> None:
    pytest.importorskip("onnxruntime")
    model = tiny_onnx.mean_network(tmp_path / "net.onnx", 45, 80, batch=3, named="depth")
    settings = replace(ALONE, multiview=str(model))
    refuses("exported for 3 views and would be wrong for 2", build_priors, room, NAMES[:2], tmp_path / "two", settings)
    assert "surfaces" in build_priors(room, NAMES, tmp_path / "three", settings).reasons(), "brightness is no depth"
    monkeypatch.setattr("d2_plugin.priors.multiview.source.understood", lambda *_: pytest.fail("computed again"))
    build_priors(room, NAMES, tmp_path / "three", replace(settings, hanging_limit=0.2))


def test_where_two_maps_conflict_stereo_says_which_is_wrong_also_beside_it() -> None:
    """As with maps of another frame: what moved lies elsewhere, and the surer map is the wrong one."""
    truth = np.full((20, 20), 4.0, np.float32)
    wrong = np.where(np.arange(20) < 10, 6.0, 4.0).astype(np.float32) * np.ones((20, 1), np.float32)
    stereo = np.where(np.arange(20)[:, None] < 10, truth, 0).astype(np.float32)
    unsure, sure = np.full_like(truth, 0.05), np.full_like(truth, 0.01)
    for vote in (
        voted(Vote(truth, unsure, unsure), Vote(wrong, sure, sure), stereo, 3.0),
        voted(Vote(wrong, sure, sure), Vote(truth, unsure, unsure), stereo, 3.0),
    ):
        np.testing.assert_allclose(vote.depth, truth, rtol=1e-6)
        assert vote.sigma[0, 0] > 0.05, "where maps part, neither is as sure as it says"
    nothing = np.zeros_like(truth)
    unheard = voted(Vote(truth, unsure, unsure), Vote(wrong, sure, sure), nothing, 3.0)
    np.testing.assert_array_equal(unheard.depth[:, :10], wrong[:, :10])
    one = voted(Vote(truth, unsure, unsure), Vote(nothing, unsure + np.inf, unsure + np.inf), stereo, 3.0)
    np.testing.assert_array_equal(one.depth, truth)
    np.testing.assert_array_equal(one.sigma, unsure)


def test_the_plan_names_the_source(room: Recording, maps: Path) -> None:
    plan = plan_scene(room, NAMES, None, replace(ALONE, multiview=str(maps)))
    assert plan.uses("multiview")
    assert not plan.uses("verification")

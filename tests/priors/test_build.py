"""Building priors: what is verified is right, nothing is computed twice, and a kill loses the frame in work."""

import contextlib
import importlib
import importlib.util
import itertools
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_onnx
import torch
from prior_cases import camera_at, contents, showing
from refusals import refuses

from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.priors.build import PriorSummary, build_priors
from d2_plugin.priors.construct import NO_MAP, SCALE_UNKNOWN
from d2_plugin.priors.dask_build import build_priors_on_cluster
from d2_plugin.priors.declared_error import held_against_truth
from d2_plugin.priors.frame import Frame
from d2_plugin.priors.monocular.align import align
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.priors.stereo import matched_depth
from d2_plugin.priors.stereo.depth_range import DepthBounds
from d2_plugin.protocol import Label
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import downscale
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

NAMES = ["train0", "train1", "train2"]
SETTINGS = PriorSettings(stereo=StereoSettings(matcher="patchmatch"))


@pytest.fixture(scope="module")
def plain() -> Recording:
    return synthetic_recording(cameras=3, held_out=1, frames=2, width=160, height=90, arc_degrees=20)


@pytest.fixture(scope="module")
def built(plain: Recording, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PriorSummary]:
    """A finished store that tests may read but not change."""
    path = tmp_path_factory.mktemp("built") / "priors"
    return path, build_priors(plain, NAMES, path, SETTINGS)


@pytest.fixture
def begun(built: tuple[Path, PriorSummary], tmp_path: Path) -> Path:
    """A copy of that store, for tests that go on with it: its stereo is not matched again."""
    return Path(shutil.copytree(built[0], tmp_path / "begun"))


def lying(plain: Recording) -> Recording:
    """One monocular map is turned around, another one is missing."""

    def mono(camera: str, frame: int) -> np.ndarray | None:
        if (camera, frame) == ("train2", 0):
            return None
        return plain.mono(camera, frame) * (-1 if (camera, frame) == ("train0", 1) else 1)

    return showing(plain, {"mono": mono})


def no_stereo(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("stereo was computed again")

    monkeypatch.setattr(matched_depth, "geometric_depth", refuse)


def errors_of(recording: Recording, store: PriorStore, label: Label) -> np.ndarray:
    """Relative errors of all pixels with a label, of the cameras of the store and the frames of the recording."""
    found = []
    for camera, frame in itertools.product(store.cameras, recording.frames):
        truth, prior = recording.depth(camera, frame), store.prior(camera, frame)
        mask = prior.labels.numpy() == label
        found.append(np.abs(prior.depth.numpy() - truth)[mask] / truth[mask])
    return np.concatenate(found)


def test_true_depth_of_another_size_is_refused(plain: Recording, built: tuple[Path, PriorSummary]) -> None:
    refuses(
        "160x90 pixels and its true depth 80x45", held_against_truth, PriorStore.open(built[0]), downscale(plain, 2)
    )


def test_verified_pixels_are_right_and_others_the_better_the_more_cameras_agree(plain: Recording, built: tuple) -> None:
    store = PriorStore.open(built[0])
    verified, agreed, alone = (errors_of(plain, store, label) for label in (Label.VERIFIED, Label.AGREED, Label.MONO))
    assert verified.size > 0.1 * 6 * 160 * 90
    assert np.median(verified) < 0.006
    assert (verified > 0.05).mean() < 0.01
    assert agreed.size > 0.02 * 6 * 160 * 90
    assert np.median(agreed) < 0.5 * np.median(alone)
    assert np.median(np.concatenate([agreed, alone])) < 0.08


def test_the_summary_and_the_record_say_what_was_built(built: tuple) -> None:
    path, summary = built
    assert (summary.built, summary.kept, summary.refused) == (6, 0, [])
    store = PriorStore.open(path)
    for camera in NAMES:
        expected = np.mean([(store.prior(camera, frame).labels.numpy() == Label.VERIFIED).mean() for frame in (0, 1)])
        assert summary.shares[camera]["verified"] == pytest.approx(expected)
        assert sum(summary.shares[camera].values()) == pytest.approx(1)
    assert "6 priors built, 0 kept" in str(summary)
    assert "train1" in str(summary)
    record = store.record("train0", 1)
    assert record["alignment"]["status"] == "ok"
    assert record["alignment"]["across"] is None, "JSON has no NaN"
    assert record["settings"]["stereo"]["matcher"] == "patchmatch"
    assert "emulated" in record["monocular"]


def test_training_cameras_alone_are_read_and_never_true_depth(plain: Recording, tmp_path: Path) -> None:
    reads = set()

    def image(camera: str, frame: int) -> np.ndarray:
        reads.add((camera, frame))
        return plain.image(camera, frame)

    recording = showing(plain, {"image": image, "depth": lambda *_: pytest.fail("true depth was read")})
    build_priors(recording, NAMES[:2], tmp_path, SETTINGS)
    assert reads == {(camera, frame) for camera in NAMES[:2] for frame in (0, 1)}


def test_a_second_build_computes_nothing_and_changes_nothing(plain: Recording, built: tuple, monkeypatch) -> None:
    no_stereo(monkeypatch)
    before, seen = contents(built[0]), []
    progress = lambda done, total, note: seen.append((done, total))  # noqa: E731
    summary = build_priors(plain, NAMES, built[0], SETTINGS, progress=progress)
    assert (summary.built, summary.kept) == (0, 6)
    assert seen == [(done, 6) for done in range(1, 7)]
    assert summary.shares == built[1].shares
    assert contents(built[0]) == before


@pytest.mark.parametrize(
    "change", [{"max_pixels": 10_000}, {"seed": 1}, {"reuse_block": 7}, {"patchmatch_device": "cpu"}]
)
def test_views_are_matched_again_where_a_setting_that_matters_changed(plain, begun, monkeypatch, change) -> None:
    no_stereo(monkeypatch)
    settings = replace(SETTINGS, stereo=replace(SETTINGS.stereo, **change))
    with pytest.raises(AssertionError) if {"max_pixels", "seed"} & {*change} else contextlib.nullcontext():
        build_priors(plain, NAMES, begun, settings)


@pytest.mark.parametrize("change", [{"uncertainty": False}, {"conflict_sigmas": 0.5, "most_vetoed": 1.0}])
def test_other_fusion_settings_reuse_the_stereo_cache(plain, begun, monkeypatch, change, caplog) -> None:
    no_stereo(monkeypatch)
    settings = replace(SETTINGS, agreement=0.0, **change)
    strict = build_priors(plain, NAMES, begun, settings)
    assert caplog.text.count("are replaced") == 1
    assert f"that were built with other {' and '.join([*change, 'agreement'])} are replaced" in caplog.text
    loose = build_priors(plain, NAMES, begun, replace(settings, tau_c=0.5, conflict_sigmas=3.0))
    assert loose.built == 6
    assert loose.shares["train0"]["verified"] > strict.shares["train0"]["verified"]
    assert loose.shares["train0"]["mono"] == strict.shares["train0"]["mono"]


def test_every_setting_of_the_construction_fuses_anew(plain: Recording, begun: Path, monkeypatch) -> None:
    no_stereo(monkeypatch)
    changes = {"conflict_sigmas": 2.0, "most_vetoed": 0.5, "tau_c": 0.2, "hanging_limit": 0.0, "color_limit": 0.0}
    settings = SETTINGS
    for name, value in (changes | {"agreement": 0.0, "far": False, "uncertainty": False, "variant": "mvs"}).items():
        settings = replace(settings, **{name: value})
        assert build_priors(plain, NAMES, begun, settings).built == 6, name


def test_maps_that_are_declared_to_be_of_another_kind_are_fused_anew(plain: Recording, begun: Path) -> None:
    assert build_priors(replace(plain, mono_kind="metric"), NAMES, begun, SETTINGS).built == 6


def test_a_changed_image_rebuilds_its_timestamp_and_no_other(plain: Recording, begun: Path, caplog) -> None:
    def image(camera: str, frame: int) -> np.ndarray:
        image = plain.image(camera, frame)
        return np.minimum(image, 250) + 5 if (camera, frame) == ("train1", 1) else image

    summary = build_priors(showing(plain, {"image": image}), NAMES, begun, SETTINGS)
    assert (summary.built, summary.kept) == (3, 3)
    assert caplog.text.count("built with other images or maps, or by another version, are replaced") == 1


def test_a_damaged_prior_is_rebuilt_and_named(plain: Recording, begun: Path, caplog: pytest.LogCaptureFixture) -> None:
    intact = contents(begun / "priors")
    file = begun / "priors" / "train2" / "00001.npy"
    file.write_bytes(file.read_bytes()[:-100])
    (begun / "cache" / "stereo" / "train0" / "00001.npy").write_bytes(b"garbage")
    (begun / "cache" / "stereo" / "train1" / "00001.json").write_bytes(b"")  # as a power cut leaves it
    summary = build_priors(plain, NAMES, begun, SETTINGS)
    assert (summary.built, summary.kept) == (1, 5)
    assert str(file) in caplog.text
    assert "are replaced" not in caplog.text
    assert contents(begun / "priors") == intact


def test_a_refused_map_leaves_stereo_as_it_is(plain: Recording, begun: Path, tmp_path: Path) -> None:
    """But for colours, which are compared with what the other cameras know."""
    shutil.copytree(begun, tmp_path / "stereo")
    alone = replace(SETTINGS, color_limit=0.0)
    summary = build_priors(lying(plain), NAMES, begun, alone)
    assert {(camera, frame) for camera, frame, _ in summary.refused} == {("train0", 1), ("train2", 0)}
    build_priors(plain, NAMES, tmp_path / "stereo", replace(alone, variant="mvs"))
    refused, stereo = PriorStore.open(begun), PriorStore.open(tmp_path / "stereo")
    for view in (("train0", 1), ("train2", 0)):
        found, expected = refused.prior(*view), stereo.prior(*view)
        assert found.verified.any()
        for map_, same in zip(found[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(map_.numpy(), same.numpy())
    assert "declared kind" in refused.record("train0", 1)["refused"]
    assert refused.record("train2", 0)["refused"] == NO_MAP


def test_in_the_paper_a_refused_view_is_empty_with_its_reason_and_the_others_are_not(plain, begun) -> None:
    summary = build_priors(lying(plain), NAMES, begun, PriorSettings.paper(stereo=SETTINGS.stereo))
    assert summary.built == 6
    refused = {(camera, frame) for camera, frame, _ in summary.refused}
    assert refused >= {("train0", 1), ("train2", 0)}
    assert len(refused) < 6
    store = PriorStore.open(begun)
    for view in refused:
        assert not store.prior(*view).support.any()
        assert not torch.isfinite(store.prior(*view).sigma).any()
    assert store.prior("train1", 1).verified.any()
    assert "refused 1x (train0/1)" in str(summary)


def test_without_monocular_depth_geometric_depth_stands_alone_and_that_is_said(plain: Recording, begun: Path) -> None:
    assert "without a second source" in str(build_priors(replace(plain, mono_kind=None), NAMES, begun, SETTINGS))
    store = PriorStore.open(begun)
    assert store.record("train0", 0)["variant"] == "mvs"
    assert set(np.unique(store.prior("train0", 0).labels)) == {Label.EMPTY, Label.VERIFIED}


def test_one_camera_has_no_depth_from_a_relative_map_and_without_one_no_source_at_all(
    plain: Recording, tmp_path: Path
) -> None:
    summary = build_priors(plain, NAMES[:1], tmp_path, SETTINGS)
    assert [reason for _, _, reason in summary.refused] == [SCALE_UNKNOWN] * 2
    assert "one camera" in str(summary)
    refuses("has no depth source", build_priors, replace(plain, mono_kind=None), NAMES[:1], tmp_path / "p", SETTINGS)
    assert not (tmp_path / "p").exists()


def test_the_papers_preset_is_the_papers_equations_and_nothing_else(plain: Recording, begun: Path, tmp_path) -> None:
    """One line fitted to the anchors, e < tau_c, D^g where verified, the aligned map where alone, no evidence."""
    settings = PriorSettings.paper(stereo=SETTINGS.stereo)
    shutil.copytree(begun, tmp_path / "mvs")
    build_priors(plain, NAMES, begun, settings)
    build_priors(plain, NAMES, tmp_path / "mvs", replace(settings, variant="mvs"))
    dual, mvs = PriorStore.open(begun), PriorStore.open(tmp_path / "mvs")
    accepted = 0
    for name in NAMES:
        found, mono, geometric = dual.prior(name, 0), plain.mono(name, 0), mvs.prior(name, 0).depth.numpy()
        alignment = align(mono, geometric, kind="relative", settings=settings.align)
        if not alignment.accepted:
            assert not found.labels.any()
            continue
        known, z_far = geometric > 0, 3 * np.percentile(geometric[geometric > 0], 99.5)
        inverse = alignment.scale * mono.astype(np.float64) + alignment.shift
        aligned = np.where(inverse > 1 / z_far, 1 / np.maximum(inverse, 1 / z_far), 0)
        verified = known & (np.abs(aligned - geometric) < 0.1 * geometric)
        labels = np.select([verified, known, aligned > 0], [Label.VERIFIED, Label.CONFLICT, Label.MONO], Label.EMPTY)
        differ = found.labels.numpy() != labels
        assert differ.mean() < 1e-3, "but where rounding of stored depth crosses a threshold"
        depth = np.select([labels == Label.VERIFIED, labels == Label.MONO], [geometric, aligned], 0)
        np.testing.assert_allclose(found.depth.numpy()[~differ], depth[~differ], rtol=1e-4)
        np.testing.assert_array_equal(found.sigma.numpy(), np.where(found.verified, 0, np.inf))
        accepted += 1
    assert accepted


def test_a_network_is_asked_once_per_image(plain: Recording, begun: Path, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("onnxruntime")
    from d2_plugin.priors.monocular.network import MonocularModel

    asked = []
    original = MonocularModel.predict
    monkeypatch.setattr(MonocularModel, "predict", lambda self, image: asked.append(1) or original(self, image))
    network = tiny_onnx.mean_network(tmp_path / "net.onnx", 45, 80)
    settings = replace(SETTINGS, mono_onnx=str(network), mono_kind="relative")
    build_priors(plain, NAMES, begun, settings)
    assert len(asked) == 6
    build_priors(plain, NAMES, begun, replace(settings, tau_c=0.3))
    assert len(asked) == 6
    refuses("mono_kind = relative", build_priors, plain, NAMES, tmp_path / "other", replace(settings, mono_kind=None))


def test_mistakes_are_told_before_anything_is_written(plain: Recording, tmp_path: Path) -> None:
    wrong = {"unknown camera 'cam7'": ["train0", "cam7"], "name at least one": [], "a duplicate": ["train0"] * 2}
    for message, names in wrong.items():
        refuses(message, build_priors, plain, names, tmp_path / "p", SETTINGS)
    says, metric = "declared relative: .* correct mono/mono.json", replace(SETTINGS, mono_kind="metric")
    refuses(says, build_priors, plain, NAMES, tmp_path / "p", metric)
    assert not (tmp_path / "p" / "priors").exists()


def test_a_build_goes_on_late_in_a_block_of_any_length(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    matched, settings = [], StereoSettings(reuse_block=2000)
    monkeypatch.setattr(matched_depth, "geometric_depth", lambda images, *_: matched.extend(images) or [])
    frames = [Frame(number, {"camera": number}, {"camera": str(number)}) for number in range(1200)]
    cameras, bounds = [camera_at(size=(1, 1))], DepthBounds(1, 2, "")
    source = matched_depth.MatchedDepth(cameras, bounds, settings, tmp_path, range(1200), frames.__getitem__)
    for frame in frames:
        source.key(frame)
    source._computed(frames[-1])
    assert matched == list(range(1200))


REUSE = PriorSettings(stereo=StereoSettings(matcher="patchmatch", reuse_block=3))
STILL_NAMES = ["train0", "train1"]


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """On disk, where other processes can read it."""
    room = synthetic_recording(cameras=2, held_out=0, frames=5, width=128, height=72, arc_degrees=10)
    return open_recording(save_recording(room, tmp_path_factory.mktemp("recording") / "room"))


@pytest.fixture(scope="module")
def still_built(still: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("built") / "priors"
    build_priors(still, STILL_NAMES, path, REUSE)
    return path


def test_what_is_carried_over_is_not_matched_and_is_verified_as_before_or_nearly(still, still_built, tmp_path) -> None:
    store = PriorStore.open(still_built)
    shares = [store.record("train0", frame)["stereo"]["matched_share"] for frame in still.frames]
    assert shares[0] == shares[3] == 1  # blocks of three
    assert max(shares[1], shares[2], shares[4]) < 0.4
    moved = replace(still, frames=(1, 2, 4))
    build_priors(moved, STILL_NAMES, tmp_path, replace(REUSE, stereo=replace(REUSE.stereo, reuse_static=False)))
    full = PriorStore.open(tmp_path)
    assert full.record("train0", 1)["stereo"]["matched_share"] == 1
    carried, matched = (errors_of(moved, each, Label.VERIFIED) for each in (store, full))
    assert len(carried) > 0.9 * len(matched)
    assert np.median(carried) < 1.1 * np.median(matched)
    assert (carried > 0.05).mean() < (matched > 0.05).mean() + 0.01


def test_a_build_that_stopped_within_a_block_goes_on_to_the_same_store(still, still_built, tmp_path) -> None:
    def stop(done: int, total: int, note: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_priors(still, STILL_NAMES, tmp_path, REUSE, progress=stop)
    build_priors(still, STILL_NAMES, tmp_path, REUSE)
    assert contents(tmp_path / "priors") == contents(still_built / "priors")


pytestmark = pytest.mark.filterwarnings("default")  # distributed deprecates its own parts between versions


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as one_worker:
        yield one_worker


def test_a_worker_killed_in_the_middle_changes_no_byte_of_the_store(still, still_built, cluster, tmp_path) -> None:
    (worker,), at, killed, seen = cluster.workers.values(), cluster.scheduler_address, [], []

    def kill(done: int, total: int, note: str) -> None:
        seen.append((done, total))
        if not killed:
            killed.append(worker.pid)
            os.kill(worker.pid, signal.SIGKILL)

    summary = build_priors_on_cluster(still, STILL_NAMES, tmp_path / "p", REUSE, scheduler=at, progress=kill)
    assert worker.pid not in killed
    assert seen[0][0] < 10
    assert seen[-1] == (10, 10)
    assert contents(tmp_path / "p") == contents(still_built)
    assert summary.built + summary.kept == 10
    assert summary.kept <= 2 * REUSE.stereo.reuse_block  # of the part that was begun twice
    alone = build_priors(still, STILL_NAMES, still_built, REUSE)
    assert alone.kept == 10
    for camera in STILL_NAMES:
        assert summary.shares[camera] == pytest.approx(alone.shares[camera])


def test_what_a_single_build_refuses_the_cluster_refuses_in_those_words(still, cluster, tmp_path, monkeypatch) -> None:
    with pytest.raises(D2Error, match="unknown camera 'train7'.*did you mean"):
        build_priors_on_cluster(still, ["train7"], tmp_path / "p", REUSE, scheduler=cluster.scheduler_address)
    client = importlib.import_module("distributed").Client
    monkeypatch.setattr("distributed.Client", lambda at, timeout, **more: client(at, timeout="0.2s", **more))
    with pytest.raises(D2Error, match="no dask scheduler answers at tcp://127.0.0.1:1 "):
        build_priors_on_cluster(still, STILL_NAMES, tmp_path / "p", REUSE, scheduler="tcp://127.0.0.1:1")
    refuses("give at least 1", build_priors_on_cluster, still, STILL_NAMES, tmp_path / "p", REUSE, workers=0)


def test_without_dask_its_extra_is_named(still: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"dask.distributed, which is not installed: .*d2-4dgs\[cluster\]"):
        build_priors_on_cluster(still, STILL_NAMES, tmp_path / "p", REUSE)

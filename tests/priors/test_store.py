"""The prior store: what comes out is what went in, damage is named, and it is whose it says."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prior_cases import contents
from refusals import refuses

from d2_plugin.priors.build import PriorSettings, PriorSummary, build_priors
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.maps import SIGMA, DepthRange, FusedPrior, encode_sigma
from d2_plugin.store.store import FORMAT, PriorStore

pytest.importorskip("cv2")

SHAPE = (12, 17)
IMAGE = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)


def some_prior(seed: int = 0) -> FusedPrior:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 4, SHAPE).astype(np.uint8)
    supported = (labels == Label.MONO) | (labels == Label.VERIFIED)
    depth = np.where(supported, rng.uniform(1, 9, SHAPE), 0).astype(np.float32)
    sigma = np.where(supported, np.exp(rng.uniform(np.log(1e-4), 0, SHAPE)), np.inf).astype(np.float32)
    return FusedPrior(depth, labels, sigma, IMAGE)


@pytest.fixture
def store(tmp_path: Path) -> PriorStore:
    made = PriorStore.create(tmp_path / "priors", ["a", "b"], [0, 3], {"recording": "test"})
    for camera in ("a", "b"):
        made.write(camera, 0, some_prior(), {"key": "k", "shares": some_prior().shares()})
    return made


def array_file(store: PriorStore, camera: str = "a") -> Path:
    return store.entries.location(camera, 0)


def test_depth_labels_sigma_and_colours_come_back(store: PriorStore) -> None:
    prior = PriorStore.open(store.path).prior("a", 0)
    expected = some_prior()
    np.testing.assert_allclose(prior.depth.numpy(), expected.depth, rtol=2e-5)
    np.testing.assert_array_equal(prior.depth.numpy() == 0, expected.depth == 0)
    np.testing.assert_array_equal(prior.labels.numpy(), expected.labels)
    np.testing.assert_allclose(prior.sigma.numpy(), expected.sigma, rtol=0.02)
    np.testing.assert_array_equal(prior.colors.numpy(), IMAGE)
    assert int(prior.verified.sum()) == int((expected.labels == Label.VERIFIED).sum())
    assert store.prior("a", 3) is store.record("b", 3) is None, "not built"


def test_a_view_of_one_pixel_comes_back(store: PriorStore) -> None:
    store.write("a", 3, FusedPrior(*(map_[:1, :1] for map_ in vars(some_prior()).values())), {})
    assert store.prior("a", 3).colors.tolist() == IMAGE[:1, :1].tolist()


@given(st.floats(1e-3, 1e3), st.floats(1, 1e9), st.integers(0, 10**6))
def test_sixteen_bits_of_logarithm_are_as_exact_as_promised(near: float, ratio: float, seed: int) -> None:
    depth = near * ratio ** np.random.default_rng(seed).random((8, 8))
    depth[0, 0] = 0
    depth_range = DepthRange.of(depth)
    decoded = depth_range.decode(depth_range.encode(depth))
    assert decoded[0, 0] == 0
    known = depth > 0
    bound = 0.51 * math.log(depth_range.far / depth_range.near) / 65534 + 3e-7
    assert np.abs(decoded[known] / depth[known] - 1).max() <= bound


def test_a_map_of_one_depth_and_a_map_of_none_survive() -> None:
    for depth in (np.full((3, 3), 2.5), np.zeros((3, 3))):
        depth_range = DepthRange.of(depth)
        np.testing.assert_allclose(depth_range.decode(depth_range.encode(depth)), depth, rtol=1e-6)


def test_sigma_above_one_is_infinite_and_only_an_exact_zero_is_zero() -> None:
    found = SIGMA[encode_sigma(np.array([0.0, 1e-9, 1e-4, 0.5, 1.0, 1.01, 1e9, np.inf], np.float32))]
    np.testing.assert_allclose(found, [0, 1e-4, 1e-4, 0.5, 1, np.inf, np.inf, np.inf], rtol=0.02)


def with_pixel(map_: str, value: float) -> FusedPrior:
    """One pixel of one map holds something else."""
    prior = some_prior(1)
    getattr(prior, map_)[2, 3] = value
    return prior


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (with_pixel("sigma", np.nan), "camera a, frame 0 has a sigma that is no map"),
        (with_pixel("sigma", -0.1), "has a sigma that is no map"),
        (replace(some_prior(), sigma=some_prior().sigma[1:]), "has a sigma that is no map"),
        (with_pixel("depth", np.nan), "camera a, frame 0 has 1 depths that are NaN, infinite or negative"),
        (with_pixel("depth", np.inf), "has 1 depths that are NaN, infinite or negative"),
        (with_pixel("depth", -1.0), "has 1 depths that are NaN, infinite or negative"),
        (replace(some_prior(), labels=np.full(SHAPE, Label.CONFLICT, np.uint8)), "contradict its depth"),
        (with_pixel("labels", 9), "label 9"),
        (replace(some_prior(), colors=IMAGE[:5]), "build the prior at the image's size"),
        (replace(some_prior(), colors=None), "its colours none"),
    ],
)
def test_maps_that_are_no_prior_are_refused_and_change_nothing(store, prior, message) -> None:
    before = contents(store.path)
    refuses(message, store.write, "a", 0, prior, {})
    assert contents(store.path) == before


@pytest.mark.parametrize(("part", "kept"), [(".npy", -40), (".npy", None), (".json", 20)])
def test_what_is_damaged_is_named_on_open(store: PriorStore, part: str, kept: int | None) -> None:
    path = array_file(store).with_suffix(part)
    whole = path.read_bytes()
    path.unlink()
    if kept is not None:
        path.write_bytes(whole[:kept])
    array = r"camera a, frame 0 is damaged .* run `d2 priors` again"
    refuses(array if part == ".npy" else "cannot read the record .*00000.json", PriorStore.open, store.path)
    if part == ".json":
        assert not store.entries.find_current("a", 0, "k")


@pytest.mark.parametrize("part", [".npy", ".json"])
def test_what_is_damaged_can_be_read_around_while_it_is_built_again(store: PriorStore, part: str) -> None:
    path = array_file(store, "b").with_suffix(part)
    path.write_bytes(path.read_bytes()[:60])
    refuses("damaged", PriorStore.open, store.path)
    with store.building():
        reader = PriorStore.open(store.path)
        assert reader.prior("b", 0) is None
        assert reader.prior("a", 0) is not None


def test_an_array_whose_record_was_not_written_yet_is_not_trusted(store: PriorStore) -> None:
    assert store.entries.find_current("a", 0, "k")
    assert not store.entries.find_current("a", 0, "other")
    record = array_file(store).with_suffix(".json")
    before = record.read_text()
    store.write("a", 0, some_prior(5), {"key": "k2"})
    record.write_text(before)  # as a kill between the two writes leaves it
    assert not store.entries.find_current("a", 0, "k")
    record.unlink()
    assert PriorStore.open(store.path).prior("a", 0) is None
    assert not store.entries.find_current("a", 0, "k")


def test_stores_of_other_recordings_formats_and_other_folders_are_refused(store: PriorStore, tmp_path: Path) -> None:
    refuses("holds the priors of test, not of other", PriorStore.create, store.path, ["a"], [0], {"recording": "other"})
    refuses("no depth priors at", PriorStore.open, tmp_path / "nowhere")
    described = json.loads((store.path / "store.json").read_text())
    (store.path / "store.json").write_text(json.dumps({**described, "format": 99}))
    refuses(f"has format 99 but this version reads format {FORMAT}: build the priors anew", PriorStore.open, store.path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("do not lose me")
    refuses("holds no prior store", PriorStore.create, tmp_path / "mine", ["a"], [0], {"recording": "test"})
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_frames_built_before_stay_part_of_the_store(store: PriorStore) -> None:
    assert PriorStore.create(store.path, ["a", "b"], [5], {"recording": "test"}).frames == (0, 3, 5)
    assert PriorStore.open(store.path).prior("a", 0) is not None


NAMES = ["train0", "train1", "train2"]
SETTINGS = PriorSettings(stereo=StereoSettings(matcher="patchmatch"))


def room(**changes: object) -> Recording:
    chosen = {"cameras": 3, "held_out": 0, "frames": 2, "width": 64, "height": 36, "arc_degrees": 20} | changes
    return synthetic_recording(**chosen)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return room()


@pytest.fixture(scope="module")
def finished(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("finished") / "store"
    built(recording, path)
    return path


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A finished store of three cameras, for a test that may change it."""
    return Path(shutil.copytree(finished, tmp_path / "store"))


def built(recording: Recording, folder: Path, names: list[str] = NAMES) -> PriorSummary:
    return build_priors(recording, names, folder, SETTINGS)


def moved(recording: Recording) -> Recording:
    camera = recording.cameras["train1"]
    pose = camera.T_camera_world + 0.01 * np.eye(4, k=3)
    return replace(recording, cameras={**recording.cameras, "train1": replace(camera, T_camera_world=pose)})


@pytest.mark.parametrize("changes", [{"seed": 5}, {}, {"width": 48, "height": 27}, {"arc_degrees": 30}])
def test_another_recording_of_the_same_name_changes_no_byte(recording: Recording, copied: Path, changes: dict) -> None:
    before, other = contents(copied), room(**changes) if changes else moved(recording)
    refuses(r"holds the priors of \S+, not of .*\(.*\): choose another output folder", built, other, copied)
    if "width" in changes:  # as with another --downscale
        refuses(r"\(camera train0 has \d+x\d+ pixels there and 48x27 here\): .* --downscale", built, other, copied)
    assert contents(copied) == before


def test_a_new_name_and_another_order_of_the_cameras_change_no_file(recording: Recording, copied: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copied.rglob("*") if path.is_file()}
    for same, names in ((recording, NAMES), (replace(recording, name="other"), NAMES), (recording, NAMES[::-1])):
        summary = built(same, copied, names)
        assert (summary.built, summary.kept) == (0, 6)
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("first", [NAMES, ["train0", "train2"]], ids=["fewer", "more"])
def test_other_cameras_of_the_recording_are_added_and_nothing_is_removed(recording, tmp_path, first) -> None:
    second = ["train0", "train2"] if first == NAMES else NAMES
    built(recording, tmp_path / "store", first)
    before = contents(tmp_path / "store")
    summary = built(recording, tmp_path / "store", second)
    after = contents(tmp_path / "store")
    assert {name: after[name] for name in before} == before
    assert summary.folder == tmp_path / "store" / "cameras" / "+".join(second)
    assert PriorStore.open(tmp_path / "store").cameras == tuple(first)
    alone = built(recording, tmp_path / "alone", second)
    for name in second:  # what was built beside others is what is built alone
        ours, theirs = PriorStore.open(summary.folder).prior(name, 1), PriorStore.open(alone.folder).prior(name, 1)
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True) if a is not None)
    again = built(recording, tmp_path / "store", second)
    assert (again.built, again.kept) == (0, 2 * len(second))
    assert contents(tmp_path / "store") == after
    assert PriorStore.located(tmp_path / "store", second) == summary.folder
    assert PriorStore.located(tmp_path / "store", first) == tmp_path / "store"


def test_names_that_no_folder_can_have_get_one(tmp_path: Path) -> None:
    about = {"recording": "room"}
    PriorStore.create(tmp_path, ["a"], [0], about)
    for names in (["a", "b/../.."], [".", "a"], ["a", "b" * 90], ["a", "."], ["a+b"], ["a", "b"]):
        store = PriorStore.create(tmp_path, names, [0], about)
        assert store.path.parent == tmp_path / "cameras"
        assert set(store.cameras) == set(names)


def test_a_build_of_other_cameras_removes_nothing_that_is_being_written(store: PriorStore) -> None:
    others = PriorStore.create(store.path, ["a"], [0], {"recording": "test"})
    with others.building():
        (others.path / ".1.part").touch()
        with store.building():
            assert (others.path / ".1.part").exists()

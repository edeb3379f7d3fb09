"""Priors in memory: for which camera, as they are stored, no more than the setting allows, read ahead in a thread."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refuses
from tiny import ALL_HOOKS, TinyStore, make_adapter, make_model, make_views

from d2_plugin import D2Hooks
from d2_plugin.hooks.prior import JUDGES, KnownMaps, PriorLoader
from d2_plugin.protocol import CameraRecord, DepthPrior, Label, View
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

SIZE = HEIGHT, WIDTH = 24, 32


def a_prior(seed: int) -> FusedPrior:
    """Depths from 1e-3 to 1e3, every label, sigmas from none to infinite."""
    rng = np.random.default_rng(seed)
    labels = rng.choice([label for label in Label if label != Label.CONFLICT], SIZE).astype(np.uint8)
    labels[:8, :8] = Label.FAR
    depth = np.where(labels == Label.EMPTY, 0, 10 ** rng.uniform(-3, 3, SIZE)).astype(np.float32)
    sigma = np.where(rng.random(SIZE) < 0.2, np.inf, 10 ** rng.uniform(-4, 0, SIZE)).astype(np.float32)
    sigma[rng.random(SIZE) < 0.1] = 0
    return FusedPrior(depth, labels, sigma, rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8))


@pytest.fixture
def store(tmp_path: Path) -> PriorStore:
    made = PriorStore.create(tmp_path / "prior", ["cam0"], range(6), {"recording": "made"})
    for frame in range(6):
        made.write("cam0", frame, a_prior(frame), {})
    return PriorStore.open(tmp_path / "prior")


def view_of(frame: int) -> View:
    return replace(make_views()[0], camera="cam0", frame=frame)


class Plain:
    """A store of one's own: it has the maps themselves."""

    def __init__(self, store: PriorStore) -> None:
        self.store, self.reads = store, []

    def prior(self, camera: str, frame: int) -> DepthPrior | None:
        self.reads.append((frame, threading.current_thread() is threading.main_thread()))
        return self.store.prior(camera, frame)


def test_codes_say_what_the_maps_say(store: PriorStore) -> None:
    coded, plain = PriorLoader(store), PriorLoader(Plain(store))
    for frame in range(3):
        view = view_of(frame)
        one, other = coded(view), plain(view)
        for ours, theirs in zip(one, other, strict=True):
            assert torch.equal(ours, theirs)
        assert torch.equal(one.reliability.bool(), one.support & (one.sigma <= JUDGES))
        for ours, theirs in zip(coded.known(view), plain.known(view), strict=True):
            assert torch.equal(torch.as_tensor(ours), torch.as_tensor(theirs))
        known = KnownMaps.of(one)
        assert (known.near, known.far) == coded.known(view)[3:]


def test_memory_holds_eight_bytes_a_pixel_and_the_log_says_when_it_is_full(store: PriorStore, caplog) -> None:
    caplog.set_level("INFO")
    loader = PriorLoader(store)
    loader.keep_bytes = 3 * 8 * HEIGHT * WIDTH
    for frame in (0, 1, 2):
        loader.known(view_of(frame))
    assert loader._bytes == loader.keep_bytes
    assert not caplog.records
    for frame in (3, 4, 5, 0):
        loader.known(view_of(frame))
        assert loader._bytes <= loader.keep_bytes
    assert [record.message for record in caplog.records] == [
        "prior_memory_mb = 0 holds the priors of 3 views: the others are read from disk each time"
    ]


def test_a_failure_ahead_is_raised_when_its_view_comes(store: PriorStore) -> None:
    loader = PriorLoader(store)
    loader.name_by(None)
    loader.prefetch([("nobody", 0), ("cam0", 1)])
    assert loader(view_of(1)) is not None
    assert loader(view_of(2)) is not None
    with pytest.raises(Exception, match="camera of the prior store"):
        loader(replace(view_of(0), camera="nobody"))


def test_what_a_trainer_says_comes_next_is_read_in_a_thread_once(store: PriorStore) -> None:
    plain = Plain(store)
    d2 = D2Hooks(ALL_HOOKS, make_adapter(make_model()), plain)
    d2.prefetch([view_of(3)])  # before the first view nobody knows what the trainer calls its cameras
    d2.loss(1, view_of(0))
    d2.prefetch([view_of(1), view_of(0), view_of(1), "a camera that nobody knows"])
    d2.loss(2, view_of(1))
    d2.loss(3, view_of(2))
    assert plain.reads == [(0, True), (1, False), (2, True)]


class RecordingStore(TinyStore):
    """The exact prior, with the cameras it was made for."""

    def camera(self, camera: str, frame: int) -> CameraRecord:
        view = next(v for v in make_views() if (v.camera, v.frame) == (camera, frame))
        return CameraRecord(view.K.double(), view.T_camera_world.double())


def load_all(change: Callable[[View], View]) -> None:
    loader = PriorLoader(RecordingStore())
    for view in make_views():
        loader(change(view))


def turned_and_shifted(view: View) -> View:
    angle, motion = torch.tensor(0.7), torch.eye(4)
    motion[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    motion[:3, 3] = torch.tensor([5.0, -3.0, 11.0])
    return replace(view, T_camera_world=view.T_camera_world @ motion)


def sloppily_orthonormal(view: View) -> View:
    pose = view.T_camera_world.clone()
    pose[0, 0] += 2e-4 * (view.camera == "cam1")
    return replace(view, T_camera_world=pose)


def scaled(view: View) -> View:
    pose = view.T_camera_world.clone()
    pose[:3, 3] *= 2
    return replace(view, T_camera_world=pose)


def swapped(view: View) -> View:
    return replace(view, camera={"cam0": "cam0", "cam1": "cam2", "cam2": "cam1"}[view.camera])


def zoomed(view: View) -> View:
    return replace(view, K=view.K * torch.tensor([1.05, 1.05, 1.0])[:, None])


def shifted_image(view: View) -> View:
    K = view.K.clone()
    K[0, 2] += 2
    return replace(view, K=K)


@pytest.mark.parametrize("change", [turned_and_shifted, sloppily_orthonormal])
def test_what_changes_no_depth_is_accepted(change: Callable[[View], View]) -> None:
    load_all(change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (scaled, r"camera at \(0.4, .*as seen from cam0 but the view is at \(0.8, .*scaled"),
        (swapped, "the key names another camera"),
        (zoomed, r"focal lengths \(30, 30\) but the view has \(31.5, 31.5\)"),
        (shifted_image, r"principal point \(16, 12\) but the view has \(18, 12\)"),
    ],
)
def test_another_camera_is_refused_with_both_values(change: Callable[[View], View], says: str) -> None:
    refuses(says, load_all, change)

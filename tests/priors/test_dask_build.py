"""Priors on a cluster: many processes, one of them killed, and still the store that one process builds."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from prior_cases import contents

from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.priors.build import PriorSummary, build_priors
from d2_plugin.priors.dask_build import build_priors_on_cluster
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")

NAMES = ["train0", "train1"]
SETTINGS = PriorSettings(stereo=StereoSettings(matcher="patchmatch", reuse_block=2))
needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="dask.distributed is not installed"
)
pytestmark = pytest.mark.filterwarnings("default")  # distributed deprecates its own parts between versions


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    rendered = synthetic_recording(cameras=2, held_out=0, frames=6, width=128, height=72, arc_degrees=10)
    return open_recording(save_recording(rendered, tmp_path_factory.mktemp("recording") / "room"))


@pytest.fixture(scope="module")
def alone(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], PriorSummary]:
    """What one process builds."""
    path = tmp_path_factory.mktemp("alone") / "priors"
    summary = build_priors(recording, NAMES, path, SETTINGS)
    return contents(path), summary


@pytest.fixture(scope="module")
def two_workers() -> Iterator[object]:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        yield cluster


def worker_pids(cluster: object) -> list[int]:
    return sorted(nanny.pid for nanny in cluster.workers.values())


@needs_dask
def test_a_worker_killed_in_the_middle_changes_no_byte_of_the_store(
    recording: Recording, alone: tuple, two_workers: object, tmp_path: Path
) -> None:
    before, killed, seen = worker_pids(two_workers), [], []

    def kill_one(done: int, total: int, note: str) -> None:
        seen.append((done, total))
        if not killed:
            killed.append(before[0])
            os.kill(before[0], signal.SIGKILL)

    store = tmp_path / "priors"
    summary = build_priors_on_cluster(
        recording, NAMES, store, SETTINGS, scheduler=two_workers.scheduler_address, progress=kill_one
    )
    assert killed
    assert killed[0] not in worker_pids(two_workers)
    assert seen[0][0] < 12
    assert seen[-1] == (12, 12)
    assert contents(store) == alone[0]
    assert summary.built + summary.kept == 12
    assert summary.kept <= 2 * SETTINGS.stereo.reuse_block  # of the part that was begun twice
    for camera in NAMES:
        assert summary.shares[camera] == pytest.approx(alone[1].shares[camera])


@needs_dask
def test_what_a_single_build_refuses_the_cluster_refuses_in_the_same_words(
    recording: Recording, two_workers: object, tmp_path: Path
) -> None:
    with pytest.raises(D2Error, match="unknown camera 'train7'.*did you mean"):
        build_priors_on_cluster(
            recording, ["train7"], tmp_path / "p", SETTINGS, scheduler=two_workers.scheduler_address
        )
    with pytest.raises(D2Error, match="no dask scheduler answers at tcp://127.0.0.1:1 "):
        build_priors_on_cluster(recording, NAMES, tmp_path / "p", SETTINGS, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(D2Error, match="give at least 1"):
        build_priors_on_cluster(recording, NAMES, tmp_path / "p", SETTINGS, workers=0)


def test_without_dask_its_extra_is_named(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"dask.distributed, which is not installed: .*d2-4dgs\[cluster\]"):
        build_priors_on_cluster(recording, NAMES, tmp_path / "p", SETTINGS)

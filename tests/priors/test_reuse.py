"""Static pixels once: what did not change is carried over, what changed is matched anew, and shards join exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.priors.build import PriorSettings, build_priors
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.geometric_depth import geometric_depth
from d2_plugin.priors.stereo.reuse import RADIUS, MatchMemory, changed
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

pytest.importorskip("cv2")

STEREO = StereoSettings(matcher="patchmatch", reuse_block=3)
SETTINGS = PriorSettings(stereo=STEREO)
NAMES = ["train0", "train1"]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(cameras=2, held_out=0, frames=5, width=128, height=72, arc_degrees=10)


@pytest.fixture(scope="module")
def built(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("built") / "priors"
    build_priors(recording, NAMES, path, SETTINGS)
    return path


def priors_of(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted((path / "priors").rglob("*.*"))}


def test_a_change_is_what_outlasts_noise_and_its_neighbourhood_changes_with_it() -> None:
    rng = np.random.default_rng(0)
    before = np.full((60, 80), 100, np.uint8)
    noisy = np.clip(before + rng.normal(0, 2, before.shape), 0, 255).astype(np.uint8)
    assert changed(noisy, before).mean() < 0.02
    moved = noisy.copy()
    moved[30:34, 40:44] += 40
    mask = changed(moved, before)
    assert mask[30 - RADIUS : 34 + RADIUS, 40 - RADIUS : 44].all()
    assert not mask[:15].any()


def test_a_scene_that_stands_still_is_matched_once() -> None:
    still = synthetic_recording(cameras=2, held_out=0, frames=2, width=128, height=72, arc_degrees=10, moving=False)
    memories, results = [MatchMemory(), MatchMemory()], []
    for frame in still.frames:
        images = [still.image(name, frame) for name in NAMES]
        results.append(geometric_depth(images, list(still.cameras.values()), (2, 9), STEREO, memories=memories))
    assert [memory.matched_share for memory in memories] == [0, 0]
    np.testing.assert_array_equal(results[0][0].depth, results[1][0].depth)


def test_the_share_that_was_matched_is_recorded_and_small(built: Path) -> None:
    store = PriorStore.open(built)
    shares = [store.record("train0", frame)["stereo"]["matched_share"] for frame in range(5)]
    assert shares[0] == shares[3] == 1  # blocks of three
    assert max(shares[1], shares[2], shares[4]) < 0.4


def test_carrying_over_does_not_change_what_is_verified_by_much(
    recording: Recording, built: Path, tmp_path: Path
) -> None:
    full = replace(SETTINGS, stereo=replace(STEREO, reuse_static=False))
    build_priors(recording, NAMES, tmp_path, full)
    results = {}
    for path in (built, tmp_path):
        store = PriorStore.open(path)
        errors = []
        for camera in NAMES:
            for frame in (1, 2, 4):
                truth, prior = recording.depth(camera, frame), store.prior(camera, frame)
                mask = prior.labels.numpy() == Label.VERIFIED
                errors.append((np.abs(prior.depth.numpy() - truth) / truth)[mask])
        results[path] = np.concatenate(errors)
    assert PriorStore.open(tmp_path).record("train0", 1)["stereo"]["matched_share"] == 1
    carried, matched = results[built], results[tmp_path]
    assert len(carried) > 0.9 * len(matched)
    assert np.median(carried) < 1.1 * np.median(matched)


def test_a_build_that_stopped_within_a_block_goes_on_to_the_same_store(
    recording: Recording, built: Path, tmp_path: Path
) -> None:
    class Stopped(Exception):
        pass

    def stop(done: int, total: int, note: str) -> None:
        if done == 3:
            raise Stopped

    with pytest.raises(Stopped):
        build_priors(recording, NAMES, tmp_path, SETTINGS, progress=stop)
    build_priors(recording, NAMES, tmp_path, SETTINGS)
    assert priors_of(tmp_path) == priors_of(built)

"""What a source says of itself, and what its numbers are measured along, reach D* through maps on disk."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.surface import back_project
from prior_cases import showing

from d2_plugin.errors import D2Error
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.maps_on_disk import planar
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore

cv2 = pytest.importorskip("cv2")

NAME = "train0"
SENSOR = StereoSettings(matcher="sensor")


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    """One camera with a depth sensor and no monocular maps of its own."""
    room = synthetic_recording(cameras=1, held_out=0, frames=1, width=96, height=54)
    room = replace(room, path=tmp_path, mono_kind=None)
    write_sensor(room, room.depth(NAME, 0), {"scale": 1.0})
    return room


def write_sensor(room: Recording, depth: np.ndarray, description: dict) -> None:
    folder = room.path / "depth" / NAME
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "00000.npy", depth)
    (folder.parent / "depth.json").write_text(json.dumps(description))


def write_confidence(room: Recording, values: np.ndarray, suffix: str = ".npy") -> None:
    folder = room.path / "depth_confidence" / NAME
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"00000{suffix}"
    assert cv2.imwrite(str(path), values) if suffix == ".png" else np.save(path, values) is None


def built(room: Recording, settings: PriorSettings | None = None) -> PriorStore:
    build_priors(room, [NAME], room.path / "store", settings or PriorSettings(stereo=SENSOR))
    return PriorStore.open(room.path / "store")


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_a_sensor_is_as_sure_as_it_says_and_a_pixel_it_does_not_trust_is_no_depth(
    recording: Recording, suffix: str
) -> None:
    before = built(recording).prior(NAME, 0)
    sure = np.ones((54, 96))
    sure[:, 30:60], sure[:, 60:] = 0.5, 0
    write_confidence(recording, np.rint(sure * 65535).astype(np.uint16) if suffix == ".png" else sure, suffix)
    after = built(recording).prior(NAME, 0)
    kept = (before.depth > 0).numpy() & (sure > 0)
    assert kept.any()
    assert (after.depth.numpy()[:, 60:] == 0).all()
    assert (after.labels.numpy()[:, 60:] == Label.EMPTY).all()
    both = kept & (after.depth > 0).numpy()
    np.testing.assert_allclose(after.depth.numpy()[both], before.depth.numpy()[both], rtol=1e-3)
    expected = before.sigma.numpy()[both] / sure[both]
    np.testing.assert_allclose(after.sigma.numpy()[both], expected, rtol=0.05)


def test_a_confidence_that_changes_builds_the_prior_anew_and_one_that_does_not_does_not(recording: Recording) -> None:
    write_confidence(recording, np.ones((54, 96)))
    settings = PriorSettings(stereo=SENSOR)
    assert build_priors(recording, [NAME], recording.path / "store", settings).built == 1
    assert build_priors(recording, [NAME], recording.path / "store", settings).built == 0
    write_confidence(recording, np.full((54, 96), 0.5))
    assert build_priors(recording, [NAME], recording.path / "store", settings).built == 1


@pytest.mark.parametrize("wrong", [-0.1, 1.5, np.nan])
def test_a_confidence_outside_of_0_to_1_is_refused_with_its_file(recording: Recording, wrong: float) -> None:
    write_confidence(recording, np.full((54, 96), wrong))
    with pytest.raises(D2Error, match=r"depth_confidence.*00000.npy .*a confidence is in 0..1"):
        built(recording)


def test_distances_along_the_ray_become_planar_depth_once(recording: Recording) -> None:
    truth = recording.depth(NAME, 0)
    camera = recording.cameras[NAME]
    distance = np.linalg.norm(back_project(camera, truth) - camera.centre, axis=-1)
    assert np.abs(distance / truth - 1).max() > 0.05
    np.testing.assert_allclose(planar(distance, camera), truth, rtol=1e-5)
    before = built(recording).prior(NAME, 0).depth
    write_sensor(recording, distance, {"scale": 1.0, "along": "ray"})
    np.testing.assert_allclose(built(recording).prior(NAME, 0).depth, before, rtol=1e-3)


def test_an_unknown_direction_is_refused(recording: Recording) -> None:
    write_sensor(recording, recording.depth(NAME, 0), {"scale": 1.0, "along": "rays"})
    with pytest.raises(D2Error, match=r"unknown along in .*depth.json 'rays'.*ray"):
        built(recording)


def test_metric_maps_may_measure_along_the_ray_and_relative_ones_may_not(tmp_path: Path) -> None:
    room = synthetic_recording(cameras=1, held_out=0, frames=1, width=96, height=54)
    truth, camera = room.depth(NAME, 0), room.cameras[NAME]
    distance = np.linalg.norm(back_project(camera, truth) - camera.centre, axis=-1).astype(np.float32)
    metric = showing(room, {"mono": lambda *_: distance}, path=tmp_path, mono_kind="metric")
    found = built(metric, PriorSettings(mono_along="ray", hanging_limit=0)).prior(NAME, 0).depth
    np.testing.assert_allclose(found, truth, rtol=1e-3)
    with pytest.raises(D2Error, match="mono_along = ray needs metric maps"):
        built(replace(metric, mono_kind="relative"), PriorSettings(mono_along="ray"))

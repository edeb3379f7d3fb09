"""Who trains from an export finds the priors of its source: by the path of the images, or by the configuration."""

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from prior_cases import write_prior
from refusals import refuses
from stand_in_recordings import smooth_recording
from tiny import TinyStore

from d2_plugin.priors.frame import describe_recording
from d2_plugin.protocol import EXPORT_FILE
from d2_plugin.recordings.export.export import export_recording
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.store.exported import RenamedStore, export_read, opened, renamed_by
from d2_plugin.store.store import PriorStore


@pytest.fixture
def exported(tmp_path: Path) -> SimpleNamespace:
    """A recording, an export of it in which every camera and frame has another name, and a prior of the recording."""
    recording = smooth_recording(("05", "07", "11"), frames=2, width=32, height=24)
    cloud = PointCloud(np.random.default_rng(0).random((200, 3)) + [0, 0, 2.0], np.full((200, 3), 0.5))
    first = [*recording.cameras][:1]
    folder = export_recording(recording, "colmap_frames", tmp_path / "data", test_cameras=first, cloud=cloud)
    write_prior(recording, tmp_path / "prior", lambda frame: 2.0 + frame)
    names = json.loads((folder / EXPORT_FILE).read_text())
    return SimpleNamespace(recording=recording, folder=folder, prior=tmp_path / "prior", names=names)


def test_the_path_of_a_image_leads_to_the_names(exported, caplog) -> None:
    source = [*exported.recording.cameras][1]
    name, frame = exported.names["cameras"][source], exported.recording.frames[-1]
    number = exported.names["frames"][str(frame)]
    assert name != source
    store = PriorStore.open(exported.prior)
    with caplog.at_level(logging.INFO):
        renamed = renamed_by(store, str(exported.folder / f"colmap_{number}" / "images" / f"{name}.png"))
    assert torch.equal(renamed.prior(name, number).depth, store.prior(source, frame).depth)
    assert "names are translated by" in caplog.text
    assert set(renamed.cameras) == set(exported.names["cameras"].values())
    assert renamed_by(store, "/somewhere/else/cam00/0.png") is store
    assert renamed_by(store, None) is store


def test_a_prior_of_the_export_itself_keeps_its_names(exported, tmp_path: Path) -> None:
    names, camera = ["cam00", "cam01"], {"size": [1, 1], "K": [[1]], "T_camera_world": [[1]]}
    about = {"recording": "data", "calibrations": dict.fromkeys(names, camera)}
    store = PriorStore.create(tmp_path / "own", names, [0], about)
    assert renamed_by(store, str(exported.folder / "cam00" / "0.png")) is store


def test_the_configuration_and_the_launcher_find_it_too(exported) -> None:
    name = exported.names["cameras"][[*exported.recording.cameras][1]]
    assert opened(str(exported.prior), str(exported.folder)).prior(name, 0) is not None
    assert export_read(exported.prior, exported.folder / "colmap_0") == exported.folder
    assert export_read(exported.prior, exported.folder.parent) is None


def test_a_prior_of_half_the_size_finds_its_names_too(exported, tmp_path: Path) -> None:
    about = describe_recording(exported.recording)
    for camera in about["calibrations"].values():
        width, height = camera["size"]
        camera["size"] = [width // 2, height // 2]
        camera["K"] = [[value / 2 for value in row] for row in camera["K"][:2]] + [[0, 0, 1]]
    PriorStore.create(tmp_path / "half", [*exported.recording.cameras], exported.recording.frames, about)
    assert export_read(tmp_path / "half", exported.folder / "colmap_0") == exported.folder
    next(iter(about["calibrations"].values()))["T_camera_world"][0][3] += 0.1
    PriorStore.create(tmp_path / "moved", [*exported.recording.cameras], exported.recording.frames, about)
    assert export_read(tmp_path / "moved", exported.folder / "colmap_0") is None


def test_an_unknown_name_says_the_way_out(exported) -> None:
    told = r"unknown camera of the prior store 'cam09'.*`exported`.*function `key`"
    refuses(told, PriorStore.open(exported.prior).prior, "cam09", 0)


def test_a_camera_of_the_recording_without_a_prior_has_none(exported, tmp_path: Path) -> None:
    some = [*exported.recording.cameras][1:]
    PriorStore.create(tmp_path / "part", some, exported.recording.frames, describe_recording(exported.recording))
    assert opened(str(tmp_path / "part"), str(exported.folder)).prior("cam00", 0) is None


def test_a_folder_without_export_is_refused(tmp_path: Path) -> None:
    refuses("give the folder that `d2 export-recording` wrote", RenamedStore.of_export, TinyStore(), tmp_path)

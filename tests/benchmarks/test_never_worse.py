"""`d2 bench never-worse`: maps are spoiled as said, all else is the same recording, and what is worse is called so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.never_worse.maps import SPOILED, Spoiled, spoiled_recording
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = synthetic_recording(2, held_out=1, frames=2, width=96, height=54, arc_degrees=15)
    return save_recording(recording, tmp_path_factory.mktemp("recordings") / "room")


@pytest.mark.parametrize("kind", SPOILED)
def test_a_spoiled_recording_differs_in_its_maps_alone(room: Path, tmp_path: Path, kind: Spoiled) -> None:
    before = open_recording(room)
    cameras = list(before.cameras)[:2]
    after = open_recording(spoiled_recording(room, cameras, None, kind, tmp_path, PriorSettings()))
    assert after.name == before.name
    assert after.mono_kind == before.mono_kind
    assert after.mono_emulated == before.mono_emulated
    for camera in cameras:
        for frame in before.frames:
            assert np.array_equal(after.image(camera, frame), before.image(camera, frame))
            assert np.array_equal(after.depth(camera, frame), before.depth(camera, frame))
            assert not np.array_equal(after.mono(camera, frame), before.mono(camera, frame))
    assert after.mono(list(before.cameras)[2], before.frames[0]) is None, "a camera that does not train needs no map"


def test_each_map_is_what_its_name_says(room: Path, tmp_path: Path) -> None:
    before = open_recording(room)
    cameras = list(before.cameras)[:2]

    def spoiled(kind: Spoiled, frames: tuple[int, ...] | None = None, folder: str = "all") -> np.ndarray:
        path = spoiled_recording(room, cameras, frames, kind, tmp_path / folder, PriorSettings())
        return open_recording(path).mono(cameras[0], 0)

    assert np.ptp(spoiled("constant")) == 0
    assert np.std(np.diff(spoiled("noise", folder="noise"))) > 2 * np.std(np.diff(spoiled("smooth", folder="smooth")))
    other = spoiled("other", folder="other")
    assert np.allclose(other, before.mono(cameras[0], before.frames[1]), atol=1e-2)
    alone = spoiled("other", (0,), "one frame")
    assert np.allclose(alone, before.mono(cameras[1], 0), atol=1e-2), "with one frame it is another camera's"

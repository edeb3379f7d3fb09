"""A recording small enough to train on in seconds."""

from pathlib import Path

import pytest
from small_layouts import write_layout

from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cameras and a held-out one, two frames of 96x54."""
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    path = tmp_path_factory.mktemp("recording") / "room"
    return save_recording(synthetic_recording(cameras=3, held_out=1, frames=2, width=96, height=54), path)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smallest recording that a command takes."""
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    return write_layout("folder", tmp_path_factory.mktemp("recording") / "small")

"""A recording small enough to train on in seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest
from small_layouts import write_layout


@pytest.fixture(scope="session")
def recording(saved_room: Callable[..., Path]) -> Path:
    """Three cameras and a held-out one, two frames of 96x54."""
    return saved_room(cameras=3, held_out=1, frames=2, width=96, height=54)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smallest recording that a command takes."""
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    return write_layout("folder", tmp_path_factory.mktemp("recording") / "small")

"""A recording small enough to train on in seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recording(saved_room: Callable[..., Path]) -> Path:
    """Three cameras and a held-out one, two frames of 96x54."""
    return saved_room(cameras=3, held_out=1, frames=2, width=96, height=54)

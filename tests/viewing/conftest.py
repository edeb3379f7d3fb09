"""A small run with all hooks, trained once for the tests of this folder."""

from collections.abc import Callable
from pathlib import Path

import pytest

from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import RunSettings
from d2_plugin.viewing.viewed import ViewedRun, viewed_run

CAMERAS = ("train0", "train1", "train2")


@pytest.fixture(scope="session")
def room(saved_room: Callable[..., Path]) -> Path:
    """A recording of three cameras and a held-out one, four frames of 96x54 at 12 per second."""
    return saved_room(cameras=3, held_out=1, frames=4, width=96, height=54)


@pytest.fixture(scope="session")
def trained(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run with all hooks."""
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    folder = tmp_path_factory.mktemp("runs") / "full"
    Run(RunSettings(str(room), CAMERAS, iterations=40), folder).train()
    return folder


@pytest.fixture(scope="session")
def bare(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two steps without any hook."""
    folder = tmp_path_factory.mktemp("runs") / "bare"
    Run(RunSettings(str(room), CAMERAS[:2], iterations=2, hooks=()), folder).train()
    return folder


@pytest.fixture(scope="session")
def viewed(trained: Path) -> ViewedRun:
    return viewed_run(trained)

"""Fixtures shared by all tests."""

import contextlib
import functools
import os
import zlib  # noqa: F401  before pycolmap, whose own copy of zlib would otherwise be bound
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

with contextlib.suppress(ImportError):
    # Its import takes over what happens at a crash, and would hide it in captured output: before pytest, which then
    # names the test and its line.
    import pycolmap  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported; see d2_plugin.commands.cli.main
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # there is a worker for each core

hypothesis.settings.register_profile("house", deadline=None)  # no test may fail because a machine is busy
hypothesis.settings.load_profile("house")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """Path of a real recording beside the checkout; skips the test, by name, where it is absent."""

    def locate(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.exists():
            pytest.skip(
                f"recording '{name}' is not in {SHARED_DATA.parent.name}/{SHARED_DATA.name} beside the checkout"
            )
        return path

    return locate


@pytest.fixture(scope="session")
def saved_room(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder of a rendered recording with these settings, written once, to be read only."""
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    from d2_plugin.recordings.export.folder import save_recording
    from d2_plugin.recordings.synthetic.room import synthetic_recording

    @functools.cache
    def write(**chosen: float) -> Path:
        return save_recording(synthetic_recording(**chosen), tmp_path_factory.mktemp("recording") / "room")

    return write


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smallest recording that a command takes, to be read only."""
    pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    from small_layouts import write_layout

    return write_layout("folder", tmp_path_factory.mktemp("recording") / "small")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The sentence with which a command line is refused."""
    import command_lines  # after the environment is set above

    return functools.partial(command_lines.refused, capsys)


@pytest.fixture
def answered(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command line that does its work prints."""
    import command_lines  # after the environment is set above

    return functools.partial(command_lines.answered, capsys)


@pytest.fixture(scope="session")
def compiler() -> None:
    """Skips the test, by name, where there is no C++ compiler."""
    from d2_plugin.compiler import NoCompiler, find_compiler

    try:
        find_compiler()
    except NoCompiler as error:
        pytest.skip(str(error))


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets torch's number of threads for a test."""
    import torch  # after the environment is set above

    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def same_for_any_threads(threads: Callable[[int], None]) -> Callable[..., None]:
    """Asserts that what a function returns, arrays or tensors, has the same bits for 1, 2 and 5 threads."""
    import numpy as np

    def check(function: Callable[[], Any]) -> None:
        results = []
        for count in (1, 2, 5):
            threads(count)
            results.append([np.asarray(part) for part in function()])
        for other in results[1:]:
            for one, two in zip(results[0], other, strict=True):
                np.testing.assert_array_equal(one, two)

    return check


GPU = pytest.param("cuda", marks=pytest.mark.cuda)


@pytest.fixture(params=["cpu", "shim", GPU])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A `Path` of the rasterizer whose kernels draw."""
    from splat_scenes import path_of

    return path_of(request.param, monkeypatch)


@pytest.fixture(params=["cpu", "shim", "torch", GPU])
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Every `Path` of the rasterizer."""
    from splat_scenes import path_of

    return path_of(request.param, monkeypatch)

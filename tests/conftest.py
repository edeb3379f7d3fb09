"""Fixtures shared by all tests."""

from __future__ import annotations

import contextlib
import os
import zlib  # noqa: F401  before pycolmap, whose own copy of zlib would otherwise be bound
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

with contextlib.suppress(ImportError):
    # Its import takes over what happens at a crash, and would hide it in captured output: before pytest, which then
    # names the test and its line.
    import pycolmap  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported; see d2_plugin.commands.cli.main

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


@pytest.fixture
def threads() -> Iterator[None]:
    """A test may set torch's number of threads."""
    import torch  # after the environment is set above

    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)

"""Fixtures of the tests that attach D2."""

from pathlib import Path

import pytest
from mimics.workplace import furnish

from d2_plugin.adapters.successors.gsplat_dynamic import GsplatDynamicAdapter


@pytest.fixture
def camera() -> dict:
    """Arguments of Inria's rasterizer."""
    from rasterizer_arguments import inria_camera, view_24x16  # what the oldest torch need not import

    return inria_camera(view_24x16())


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a prior and a d2.toml; the one camera of gsplat's dynamic trainer is the middle one there."""
    monkeypatch.setitem(GsplatDynamicAdapter.__init__.__kwdefaults__, "camera", "cam1")
    return furnish(tmp_path, monkeypatch)

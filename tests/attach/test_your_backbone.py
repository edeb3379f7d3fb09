"""docs/your-backbone.md is true: its blocks, put into files as printed, pass their test and train with the hooks."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from prior_cases import write_prior
from stand_in_recordings import smooth_recording
from tiny import make_model

from d2_plugin import registry
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-backbone.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
CAMERAS = ("00", "01", "02")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The files of the page, a recording, and a prior of it."""
    for name, block in zip(("drift.py", "test_drift.py", "train.py"), BLOCKS, strict=True):
        (tmp_path / name).write_text(block)
    save_recording(smooth_recording(CAMERAS, frames=2, width=32, height=24), tmp_path / "recording")
    write_prior(open_recording(tmp_path / "recording"), tmp_path / "prior", lambda frame: 3.0)
    return tmp_path


SCRIPT = """
import runpy, sys
import no_dynamo
from test_drift import test_drift_keeps_the_contract
test_drift_keeps_the_contract()
sys.argv = ["train.py", "recording", "prior", "00,01,02", "120"]
runpy.run_path("train.py", run_name="__main__")
sys.stderr.write("end of the script\\n")
"""


def test_the_example_keeps_the_contract_trains_with_every_hook_and_is_not_silent(folder: Path) -> None:
    """A program without logging shows what was attached, and a summary once it ends."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": f"{folder}:{Path(__file__).parents[1]}"}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    errors = [float(error) for error in re.findall(r"L1 ([\d.]+)", done.stdout)]
    assert errors[-1] < errors[0]
    said = done.stderr.splitlines()
    assert said[0].startswith("d2: attached by Drift to 500 Gaussians")
    assert said[-2] == "end of the script"
    assert re.match(r"d2: densify, prune, depth_loss: [1-9]\d* inserted, [1-9]\d* removed, ", said[-1])
    first, last = re.search(r"depth_loss (\S+) at first, (\S+) at last", said[-1]).groups()
    assert float(last) < float(first) / 2


def test_somebody_elses_backbone_is_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their distribution with a backbone and an adapter, as pip would leave it."""
    info = tmp_path / "their_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    points = "[d2_plugin.backbones]\ntheirs = their_module\n[d2_plugin.adapters]\ntheirs = their_module:adapt\n"
    (info / "entry_points.txt").write_text(points)
    (tmp_path / "their_module.py").write_text(
        "from d2_plugin.adapters.yang4d import Yang4DAdapter as adapt\n"
        "from d2_plugin.backbones.yang4d import Trainer, TrainSettings, create, settings_from\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert "theirs" in registry.names(registry.BACKBONES)
    module = registry.load(registry.BACKBONES, "theirs")
    assert all(hasattr(module, name) for name in ("create", "settings_from", "Trainer", "TrainSettings"))
    assert len(registry.load(registry.ADAPTERS, "theirs")(make_model())) == 60
    del sys.modules["their_module"]

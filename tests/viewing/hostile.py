"""Runs that are not as a newcomer's first one: unfinished, emptied, of another version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import torch

from d2_plugin.durable import write_table
from d2_plugin.runs.saved import RUN, save_checkpoint


def still_training(trained: Path, copy: Path, step: int) -> Path:
    """A copy of a run at an earlier step."""
    shutil.copytree(trained, copy)
    state = torch.load(copy / "checkpoint.pt", weights_only=True)
    save_checkpoint(copy / "checkpoint.pt", state | {"step": step})
    return copy


def emptied(trained: Path, copy: Path) -> Path:
    """A copy of a run without any Gaussian."""
    shutil.copytree(trained, copy)
    state = torch.load(copy / "checkpoint.pt", weights_only=True)
    state["model"] = {
        "parameters": {name: value[:0] for name, value in state["model"]["parameters"].items()},
        "statistics": {name: value[:0] for name, value in state["model"]["statistics"].items()},
        "optimizer": state["model"]["optimizer"] | {"state": {}},
    }
    save_checkpoint(copy / "checkpoint.pt", state)
    return copy


def of_another_version(trained: Path, copy: Path) -> Path:
    """A copy of a run that a later program wrote."""
    shutil.copytree(trained, copy)
    table = json.loads((copy / "run.json").read_text())
    plain = {name: value for name, value in table.items() if name not in ("format", "seal")}
    write_table(copy / "run.json", plain | {"version": 99}, RUN)
    return copy

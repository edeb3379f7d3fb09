"""Where a figure comes from: the machine, the versions and the commit that every row of a measurement carries."""

from __future__ import annotations

import functools
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from d2_plugin import __version__

if TYPE_CHECKING:
    from d2_plugin.runs.run import Run


def circumstances(device: torch.device | str = "cpu") -> dict[str, str | int | None]:
    """Device, threads, versions and commit, for a row of results."""
    device = torch.device(device)
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name(),
        "threads": torch.get_num_threads(),
        "version": __version__,
        "commit": commit(),
        "torch": torch.__version__,
    }


def provenance(row: Mapping[str, Any]) -> str:
    """One sentence for a caption, from a row that has what `circumstances` gives and the `command`."""
    where = f"{row['device']}, {row['threads']} threads, torch {row['torch']}"
    return f"{where}, commit {row['commit'] or row['version']}, `{row['command']}`."


def cpu_name() -> str:
    """What the processor calls itself."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def commit() -> str | None:
    """The commit of the checkout when first asked, with + where files differ; None for an installed package."""
    try:
        found, changed = _git("rev-parse", "--short", "HEAD"), _git("status", "--porcelain", "--", "..")
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.strip() + ("+" if changed else "")


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout


def about(run: Run, trainer: Any) -> dict[str, Any]:
    """What metrics.json says beside the scores: the run, its cost, and the machine."""
    scene = run.scene
    return {
        "gaussians": len(trainer.model),
        "iterations": trainer.step,
        "seconds": {name: round(value, 3) for name, value in run.seconds.items()},
        "cpu_seconds": {name: round(value, 3) for name, value in run.cpu_seconds.items()},
        "train_cameras": list(scene.train_cameras),
        "test_cameras": list(scene.test_cameras),
        "protocol": run.settings.protocol,
        "backbone": run.settings.backbone,
        "hooks": list(run.settings.hooks),
        "guidance": None if run.guidance is None else dict(run.guidance.identity()),
        "retired": run.retired,
        "background": getattr(trainer.model, "background", None) is not None,
        "appearance": getattr(trainer.model, "appearance", None) is not None,
        "clocks": None if getattr(trainer.model, "clocks", None) is None else trainer.model.clocks.in_frames(),
        "prior": run.prior,
        "trials": None if run.trials is None else run.trials.as_dict(),
        "plan": scene.plan.as_dict(),
        "capture": scene.capture.name,
        "mono_emulated": scene.capture.mono_emulated,
        "notes": list(scene.capture.notes),
        "made": circumstances(),
    }

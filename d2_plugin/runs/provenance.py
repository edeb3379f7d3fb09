"""Where a figure comes from: the machine, the versions and the commit that every row of a measurement carries."""

from __future__ import annotations

import functools
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from d2_plugin import __version__


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
        revision, changed = _git("rev-parse", "--short", "HEAD"), _git("status", "--porcelain", "--", "..")
    except (OSError, subprocess.CalledProcessError):
        return None
    return revision.strip() + ("+" if changed else "")


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout

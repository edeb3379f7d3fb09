"""One run of an ablation, and what it leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from d2_plugin.runs.settings import RunSettings

Metrics = Mapping[str, Any]
"""What metrics.json of a run holds."""


@dataclass(frozen=True, eq=False)
class Job:
    """One run of an ablation."""

    preset: str
    backbone: str
    seed: int
    settings: RunSettings
    folder: Path

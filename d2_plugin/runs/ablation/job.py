"""One run of an ablation, and what it leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.rivals.table import rival
from d2_plugin.runs.run import Run
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
    rival: str | None = None
    """What guides it in place of D2's hooks."""

    def run(self) -> Run:
        """The run in its folder; refuses a folder of other settings, with one sentence."""
        return Run(self.settings, self.folder, rival(self.rival, self.settings.iterations))

"""The paper's ablation tables on this recording, over several seeds."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.commands.arguments.form import Form, Given
from d2_plugin.commands.arguments.recording import ConfigFile, recording_form, run_settings
from d2_plugin.settings import AtATime, Range, Seed


@dataclass(frozen=True, kw_only=True)
class AblationOptions(ConfigFile):
    """Which variants are trained, and how often."""

    output: Path
    """Folder of runs, shared priors and tables."""
    rows: tuple[str, ...] = ("ablation", "pruning")
    """Tables (ablation, pruning, main) or presets, joined by commas; an unknown name shows the list."""
    backbones: tuple[str, ...] = ("yang4d",)
    """Names joined by commas."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Numbers joined by commas."""
    iterations: Annotated[int, Range(1, unit="steps")] = 2000
    """Optimizer steps of each run, one view each."""
    jobs: AtATime = os.cpu_count() or 1
    """Runs at a time, one thread each."""


def form(words: list[str]) -> Form:
    """What `d2 ablate` takes."""
    return recording_form("d2 ablate", __doc__, run, ("test_cameras", "hold_out_instants"), AblationOptions)


def run(given: Given) -> str:
    """Train what is not finished; returns the tables."""
    from d2_plugin.runs.ablation.ablate import ablate
    from d2_plugin.runs.ablation.presets import rows_named

    options = given.make(AblationOptions)
    words = [Path(word).name if word.startswith("/") else word for word in sys.argv[1:]]  # no folders of this machine
    chosen = rows_named(options.rows), options.backbones, options.seeds
    text = ablate(run_settings(given), *chosen, options.output, options.jobs, " ".join(["d2", *words]))
    return f"{text}\ntables and runs.jsonl in {options.output}"

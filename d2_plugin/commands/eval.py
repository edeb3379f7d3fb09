"""Score the held-out cameras of a trained run again.

LPIPS is measured once `pip install lpips` and, with a network, `python -c "import lpips; lpips.LPIPS(net='alex')"` have
brought its weights; FLIP once `pip install flip-evaluator` was run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.settings import Positional, Settings


@dataclass(frozen=True)
class Evaluation(Settings):
    """Which run is scored."""

    run_folder: Annotated[Path, Positional()]
    """The --output of `d2 train`."""
    recording: Path | None = None
    """Where its recording lies now, if that was moved; the run remembers it."""
    no_images: bool = False
    """Scores only."""


def run(settings: Evaluation) -> str:
    """Score the run; returns the table."""
    from d2_plugin.runs.run import Run
    from d2_plugin.runs.tables import metrics_table

    metrics = Run.load(settings.run_folder, settings.recording).evaluate(images=not settings.no_images)
    return metrics_table({settings.run_folder.resolve().name: metrics})

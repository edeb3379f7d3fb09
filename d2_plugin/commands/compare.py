"""One Markdown table of the scores of several runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.settings import Positional, Settings


@dataclass(frozen=True)
class Comparison(Settings):
    """Which runs stand in the table."""

    run_folders: Annotated[tuple[Path, ...], Positional()]
    """The --output folders of `d2 train`."""


def run(settings: Comparison) -> str:
    """The table."""
    from d2_plugin.runs.saved import read_metrics
    from d2_plugin.runs.tables import metrics_table

    return metrics_table({folder.name: read_metrics(folder) for folder in settings.run_folders})

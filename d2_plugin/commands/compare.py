"""One Markdown table of the scores of several runs, and a page that shows two of them beside each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.errors import D2Error
from d2_plugin.settings import Positional, Settings


@dataclass(frozen=True)
class Comparison(Settings):
    """Which runs stand in the table."""

    run_folders: Annotated[tuple[Path, ...], Positional()]
    """The --output folders of `d2 train`."""
    page: Path | None = None
    """HTML file to write: two runs and the recording beside each other, as `d2 export A B` writes it."""


def run(settings: Comparison) -> str:
    """The table, and where the page is."""
    from d2_plugin.runs.saved import read_metrics
    from d2_plugin.runs.tables import metrics_table

    if not settings.run_folders:
        raise D2Error("no run is given: name the --output folders of `d2 train`")
    names = [folder.resolve().name for folder in settings.run_folders]
    rows = {n if names.count(n) == 1 else str(f): read_metrics(f) for n, f in zip(names, settings.run_folders)}
    table = metrics_table(rows)
    hashed = all("images_by_camera" in metrics for metrics in rows.values())
    scored = [
        [
            (view["camera"], view["frame"], hashed and m["images_by_camera"].get(view["camera"]))
            for view in m["per_view"]
        ]
        for m in rows.values()
    ]
    if any(views != scored[0] for views in scored):
        table += "\nnot the same images were scored (recording, cameras, frames, size): such rows do not compare"
    if settings.page is None:
        return table
    from d2_plugin.viewing.export.page import write_page
    from d2_plugin.viewing.export.scene import export_scene
    from d2_plugin.viewing.viewed import viewed_run

    write_page([export_scene(viewed_run(folder)) for folder in settings.run_folders], settings.page)
    return f"{table}\nPage: {settings.page}"

"""`d2 demo`: a synthetic recording, the backbone alone and with D2, a table and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.captures import open_capture
from d2_plugin.captures.export.folder import save_capture
from d2_plugin.captures.pictures import read_picture, write_png
from d2_plugin.captures.synthetic.room import split, synthetic_capture
from d2_plugin.runs.drawing import BACKGROUND, text
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings
from d2_plugin.runs.tables import metrics_table

LARGER_BUDGET = {"d2": {"views_per_evaluation": 8}, "densify": {"budget_per_view": 500}}
"""Eight times the samples in twice the views: more quality for more time than the defaults, which cost little time."""

VARIANTS = {
    "backbone": ((), {}),
    "backbone + D2": (HOOK_NAMES, {}),
    "D2, larger budget": (HOOK_NAMES, LARGER_BUDGET),
}
"""Name -> hooks and settings over the defaults."""


def run_demo(folder: Path, iterations: int) -> str:
    """Write capture, three runs and comparison.png under `folder`; returns the table to print.

    All runs start from the same points and take the same number of iterations; a demo that was cut off goes on.
    """
    path = folder / "capture"
    if not path.is_dir():
        save_capture(synthetic_capture(), path)
    train, held_out = split(open_capture(path))
    runs = {}
    for name, (hooks, overrides) in VARIANTS.items():
        settings = RunSettings(
            *(str(path), tuple(train)),
            iterations=iterations,
            hooks=hooks,
            overrides=overrides,
            priors=str(folder / "priors") if hooks else None,
        )
        run = Run(settings, folder / name.replace(" + ", "_").replace(", ", "_").replace(" ", "_").lower())
        run.train()
        runs[name] = (run, run.evaluate())
    picture = folder / "comparison.png"
    _compare({name: run.folder for name, (run, _) in runs.items()}, held_out[len(held_out) // 2], picture)
    table = metrics_table({name: metrics for name, (_, metrics) in runs.items()})
    return f"{table}\nThe recording is rendered and its monocular depth is emulated.\nPicture: {picture}"


def _compare(folders: dict[str, Path], camera: str, picture: Path) -> None:
    """The same held-out view of every run, one row of panels per run."""
    rows: list[np.ndarray] = []
    for name, folder in folders.items():
        found = sorted((folder / "pictures").glob(f"{camera}_*.png"))
        panels = read_picture(found[len(found) // 2])
        title = np.full((14, panels.shape[1], 3), BACKGROUND, np.uint8)
        letters = text(name)
        title[4 : 4 + len(letters), 2 : 2 + letters.shape[1]] = letters
        rows += [title, panels]
    write_png(picture, np.concatenate(rows))

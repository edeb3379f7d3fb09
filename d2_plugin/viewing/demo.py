"""`d2 demo`: a synthetic recording, the backbone alone and with D2, a table, an image and a player."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from d2_plugin.gaussians import native_slice, native_ssim
from d2_plugin.rasterizer import native as native_rasterizer
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import read_image, write_png
from d2_plugin.recordings.synthetic.room import split, synthetic_recording
from d2_plugin.runs.drawing import BACKGROUND, text
from d2_plugin.runs.run import Run
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings
from d2_plugin.runs.tables import metrics_table
from d2_plugin.settings import Range, Settings
from d2_plugin.viewing.export.page import write_page
from d2_plugin.viewing.export.scene import export_scene
from d2_plugin.viewing.viewed import viewed_run

VARIANTS = {"backbone": (), "backbone + D2": HOOK_NAMES}
"""Name -> hooks."""


@dataclass(frozen=True)
class Demo(Settings):
    """What the demo writes, and how long it trains."""

    output: Path = Path("d2-demo")
    """Folder of the recording, the runs and the image."""
    iterations: Annotated[int, Range(1, unit="steps")] = 1000
    """Optimizer steps of each of the two runs."""


def run(settings: Demo) -> str:
    """Write the recording, two runs, comparison.png and player.html; returns the table to print.

    All runs start from the same points and take the same number of iterations; a demo that was cut off goes on.
    """
    folder = settings.output
    path = folder / "recording"
    if not path.is_dir():  # one that is there is whole, because it is written beside and renamed
        save_recording(synthetic_recording(), path)
    for compiled in (native_rasterizer.available, native_slice.library, native_ssim.library):
        compiled()  # before the clock starts: the first run would pay for all of them
    train, held_out = split(open_recording(path))
    runs, scores = {}, {}
    for name, hooks in VARIANTS.items():
        chosen = RunSettings(
            *(str(path), tuple(train)),
            iterations=settings.iterations,
            hooks=hooks,
            priors=str(folder / "priors") if hooks else None,
        )
        runs[name] = Run(chosen, folder / name.replace(" + ", "_").lower())
        runs[name].train()
        scores[name] = runs[name].evaluate()
    image = folder / "comparison.png"
    _compare({name: run.folder for name, run in runs.items()}, held_out[len(held_out) // 2], image)
    table = metrics_table(scores)
    page = folder / "player.html"
    write_page([export_scene(replace(viewed_run(run.folder), name=name)) for name, run in runs.items()], page)
    return (
        f"{table}\nThe recording is rendered and its monocular depth is emulated.\nImage: {image}\n"
        f"Player: {page} (open it in a browser; it compares both with the recording, without a network)"
    )


def _compare(folders: dict[str, Path], camera: str, image: Path) -> None:
    """The same held-out view of every run, one row of panels per run."""
    rows = []
    for name, folder in folders.items():
        images = sorted((folder / "images").glob(f"{camera}_*.png"))
        panels = read_image(images[len(images) // 2])
        title = np.full((24, panels.shape[1], 3), BACKGROUND, np.uint8)
        letters = text(name, 2)
        title[2 : 2 + letters.shape[0], 4 : 4 + letters.shape[1]] = letters
        rows += [title, panels]
    write_png(image, np.concatenate(rows))

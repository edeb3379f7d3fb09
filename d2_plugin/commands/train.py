"""Train on some cameras and score on the others; a stopped run is continued."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from d2_plugin.commands.arguments.form import Form, Given
from d2_plugin.commands.arguments.recording import (
    ConfigFile,
    recording_form,
    run_settings,
    show_notes,
    show_plan,
    table_of_config,
)
from d2_plugin.progress import show

OF_THE_RUN = (
    *("test_cameras", "backbone", "iterations", "hooks", "priors", "accept_empty_prior"),
    *("hold_out_instants", "background_weight", "seed", "device"),
)


@dataclass(frozen=True, kw_only=True)
class TrainOptions(ConfigFile):
    """What `d2 train` takes beside the settings of the run."""

    output: Path
    """Folder of the run; an unfinished run in it is continued."""
    calibration: Path | None = None
    """Of the cameras where RECORDING is a folder of videos: they are imported first, into OUTPUT-recording. With it
    there is a table of settings more, `import`."""
    view: bool = False
    """Watch it train on a page in the browser."""


def form(words: list[str]) -> Form:
    """What `d2 train` takes."""
    return recording_form("d2 train", __doc__, run, OF_THE_RUN, TrainOptions)


def run(given: Given) -> str:
    """Train to the end and score; returns the table of scores."""
    from d2_plugin.runs.run import Run
    from d2_plugin.runs.settings import HOOK_NAMES
    from d2_plugin.runs.tables import metrics_table
    from d2_plugin.store.store import PriorStore

    options = given.make(TrainOptions)
    if given.values["priors"] is not None:
        PriorStore.described(Path(given.values["priors"]))  # nothing is built under a name that was mistyped
    given = _imported(given, options)
    run = Run(run_settings(given), options.output)
    idle = [name for name in given.tables if name in HOOK_NAMES and name not in run.settings.hooks]
    idle_notes = (f"--{name.replace('_', '-')}.* changes nothing: --hooks leaves {name} out" for name in idle)
    show_notes((*run.scene.recording.notes, *idle_notes))
    show_plan(run.scene.plan)
    live = None
    if options.view:
        from d2_plugin.extras import imported
        from d2_plugin.viewing.live.show import LiveRun

        imported("viser", "viser", "view", "the live viewer")  # asked for before anything is computed
        live = LiveRun(run)
    run.train(on_prior=lambda summary: show(str(summary)), watch=None if live is None else live.watch)
    if run.trials is not None:
        show(run.trials["text"])
    show_notes([f"{name} retired at step {step}: it changed next to nothing" for name, step in run.retired.items()])
    metrics = run.evaluate()
    if metrics["background"]:
        show("background: directions have a colour of their own, behind all Gaussians")
    if live is not None:
        live.stay()
    table = metrics_table({options.output.resolve().name: metrics})
    where = f"metrics in {options.output / 'metrics.json'}, images in {options.output / 'images'}"
    return "\n".join([table, where, *([] if run.prior is None else [run.prior["headline"]])])


def _imported(given: Given, options: TrainOptions) -> Given:
    """What was given, with videos replaced by the recording that they become; an unfinished import goes on."""
    from d2_plugin.recordings.importing.importing import import_videos
    from d2_plugin.recordings.importing.settings import ImportChoices, ImportSettings

    videos = Path(given.values["recording"])
    if options.calibration is None:
        return given
    chosen = ImportChoices.from_dict(table_of_config(given, "import"), "import")
    folder = Path(f"{os.path.abspath(options.output)}-recording")
    settings = ImportSettings(videos=(videos,), calibration=options.calibration, output=folder, **vars(chosen))
    import_videos(settings, report=show)
    return replace(given, values={**given.values, "recording": str(folder)})

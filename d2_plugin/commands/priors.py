"""Build the depth prior of a recording; finished frames are kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from d2_plugin.commands.arguments.form import Form, Given
from d2_plugin.commands.arguments.recording import ConfigFile, recording_form, run_settings, show_notes, show_plan
from d2_plugin.errors import D2Error
from d2_plugin.progress import show
from d2_plugin.settings import AtATime

HELD_FRAMES = 8
"""At most this many frames are held against the true depth: the errors of all their pixels are in memory at once."""


@dataclass(frozen=True, kw_only=True)
class PriorOptions(ConfigFile):
    """Where the prior goes and what builds it."""

    output: Path
    """Folder of the prior store."""
    shard: str | None = None
    """Build part I of N only, as I/N with I from 1 to N."""
    workers: AtATime | None = None
    """Build with this many processes on this machine."""
    scheduler: str | None = None
    """Address of a dask cluster to build on, as tcp://host:8786."""


def form(words: list[str]) -> Form:
    """What `d2 priors` takes."""
    return recording_form("d2 priors", __doc__, run, (), PriorOptions, ("priors", "plan"))


def run(given: Given) -> str:
    """Build what is missing; returns a summary of the frames."""
    from d2_plugin.durable import CannotWrite, make_folder
    from d2_plugin.locks import in_turn
    from d2_plugin.priors.declared_error import frames_with_truth, held_against_truth
    from d2_plugin.priors.sheet import contact_sheet
    from d2_plugin.runs.prior.build import build_priors_for
    from d2_plugin.runs.prior.trials import can_decide, tried
    from d2_plugin.runs.scene import Scene
    from d2_plugin.runs.settings import check
    from d2_plugin.runs.start import triangulated_points
    from d2_plugin.store.store import PriorStore

    options = given.make(PriorOptions)
    shard, cluster = part_of(options.shard), cluster_of(options)
    settings = check(replace(run_settings(given), test_cameras=()))  # which may have no images yet
    scene = Scene.open(settings)
    make_folder(options.output)  # or say at once that it cannot be
    show_notes(scene.recording.notes)
    show_plan(scene.plan)
    points = triangulated_points(scene.recording, scene.train_cameras)
    summary = build_priors_for(scene, points.positions, options.output, shard=shard, cluster=cluster)
    show(str(summary), summary.headline())
    folder = summary.folder or options.output
    if folder.absolute() != options.output.absolute():  # a cluster says whole paths
        show_notes([f"{options.output} holds the priors of other cameras, which stay; those of these are in {folder}"])
    if shard is not None:
        return f"part {options.shard} of the prior is in {folder}"
    store, sheet = PriorStore.open(folder), folder / "contact_sheet.png"
    frames = frames_with_truth(scene.recording, scene.train_cameras, HELD_FRAMES)
    calibration = held_against_truth(store, scene.recording, frames)
    if calibration is not None:
        show(str(calibration))
    if summary.usable and can_decide(settings, scene):
        show(tried(settings, scene, points, folder)["text"])
    try:
        with in_turn(options.output):
            contact_sheet(store, scene.recording, sheet)
    except CannotWrite as error:
        if summary.built:
            raise
        return f"all was there already; {error}"  # a finished prior may lie where nobody can write
    return f"look at {sheet}"


def part_of(text: str | None) -> tuple[int, int] | None:
    """(index from 0, count) of I/N."""
    if text is None:
        return None
    try:
        part, count = (int(number) for number in text.split("/"))
    except ValueError:
        raise D2Error(f"--shard is '{text}': give I/N, as in 1/4") from None
    if not 1 <= part <= count:
        raise D2Error(f"--shard asks for part {part} of {count}: parts are 1 to {count}")
    return part - 1, count


def cluster_of(options: PriorOptions) -> dict[str, Any] | None:
    """What builds the frames, if not this process."""
    if options.workers is None and options.scheduler is None:
        return None
    if options.shard is not None:
        raise D2Error("--shard builds one part on this machine: leave it out with --workers or --scheduler")
    if options.scheduler is None:
        return {"workers": options.workers}
    from d2_plugin.priors.dask_build import cluster_client  # needs an extra

    with cluster_client(options.scheduler, 0):  # or say at once that nobody answers
        return {"scheduler": options.scheduler}

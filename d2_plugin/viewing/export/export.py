"""`d2 export`: a trained run as files that others open; see `FORMATS`."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from d2_plugin.durable import make_folder, remove_leftovers
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.progress import progress_bar
from d2_plugin.settings import Count, Downscale, Positional, Range, Settings
from d2_plugin.viewing.checkpoints import open_viewed
from d2_plugin.viewing.export.compact import compacted
from d2_plugin.viewing.export.fourdgs import write_4dgs
from d2_plugin.viewing.export.page import write_page
from d2_plugin.viewing.export.ply import write_ply
from d2_plugin.viewing.export.scene import ExportScene, export_scene

CONVERTER = "splat-transform"
"""PlayCanvas's program, which reads and writes the formats of single instants."""


@dataclass(frozen=True)
class Export(Settings):
    """Which run is exported, as what."""

    runs: Annotated[tuple[Path, ...], Positional()]
    """The --output of `d2 train`, of two runs for a page that compares; or what an official trainer wrote, with
    --recording."""
    format: Literal["html", "ply", "sog", "spz", "glb", "4dgs"] = "html"
    """html: one page that plays the scene, or compares two, without a network. ply, sog, spz, glb (glTF): a file for
    each frame. 4dgs: the moving scene."""
    output: Path | None = None
    """Folder to write into; `export` inside the last run's folder if not given."""
    frames: tuple[Count, ...] | None = None
    """first:last or first:last:step, the last one included, of a file for each frame; all frames if not given."""
    keep: Annotated[float, Range(0, 1, open_low=True)] = 1.0
    """Share of the Gaussians that is kept: those that training images would miss least go, the others train on for a
    few hundred steps. What that costs is measured and said."""
    recording: Path | None = None
    """The recording of a checkpoint of an official trainer."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with; all but these are held out."""
    downscale: Downscale = 1
    """For such a checkpoint: the recording's cameras with images this many times smaller."""


Written = tuple[list[Path], list[str]]
"""What a format has written, and what a person should know about it."""


def run(settings: Export) -> str:
    """Write the export; returns what was written, how large it is, and how far off."""
    if settings.frames is not None and settings.format not in FRAME_FORMATS:
        raise D2Error(
            f"--frames is for {', '.join(FRAME_FORMATS)}: {settings.format} holds the whole clip, leave it out"
        )
    if not 1 <= len(settings.runs) <= (2 if settings.format == "html" else 1):
        raise D2Error(f"{len(settings.runs)} runs are given: give one, or for a page of html one or two")
    if settings.format in CONVERTED and shutil.which(CONVERTER) is None:
        raise D2Error(
            f"{settings.format} is written by {CONVERTER}, which is not installed: run `npm install -g "
            f"@playcanvas/{CONVERTER}`, or choose --format ply"
        )
    checkpoint = settings.recording, settings.train_cameras, settings.downscale
    shown, path = [open_viewed(path, *checkpoint) for path in settings.runs], settings.runs[-1]
    if settings.keep < 1:
        shown = [compacted(viewed, settings.keep) for viewed in shown]
    output = settings.output or (path.parent if path.is_file() else path) / "export"
    paths, notes = write_export([export_scene(viewed) for viewed in shown], settings, output)
    what = f"{len(paths)} files in {paths[0].parent}" if len(paths) > 1 else str(paths[0])
    size = sum(path.stat().st_size for path in paths) / 1e6
    return "\n".join([f"{what} ({size:.1f} MB)", *notes])


def write_export(scenes: list[ExportScene], settings: Export, folder: Path) -> Written:
    """Write the scenes under `folder` in the format that the settings name."""
    [*_, scene] = scenes
    with only_writer(make_folder(folder)):
        remove_leftovers(folder)
        if settings.format == "html":
            return [folder / "scene.html"], write_page(scenes, folder / "scene.html")
        if settings.format == "4dgs":
            paths, notes = [folder / "scene.4dgs"], write_4dgs(scene, folder / "scene.4dgs")
        else:
            paths, notes = _frame_files(scene, settings, folder / settings.format), []
    notes = [*scene.viewed.note.splitlines(), *notes]
    if scene.background is not None:
        notes = [*notes, "the background behind the Gaussians is left out: the format has no place for it, html has"]
    return paths, notes


def _frame_files(scene: ExportScene, settings: Export, folder: Path) -> list[Path]:
    chosen = scene.viewed.recording.frames if settings.frames is None else settings.frames
    for frame in chosen:
        if frame not in scene.viewed.recording.frames:
            first, last = scene.viewed.recording.frames[0], scene.viewed.recording.frames[-1]
            raise D2Error(f"the run has no frame {frame}: it has {first} to {last}; name some of those in --frames")
    if not chosen:
        raise D2Error("--frames names no frame: give first:last, or leave it out for all of them")
    make_folder(folder)
    paths = list[Path]()
    with progress_bar(settings.format, len(set(chosen))) as bar, tempfile.TemporaryDirectory() as between:
        for frame, time in zip(scene.viewed.recording.frames, scene.seconds):
            if frame in chosen:
                paths.append(folder / f"frame_{frame:05d}.{settings.format}")
                ply = paths[-1] if settings.format == "ply" else Path(between) / "frame.ply"
                write_ply(ply, *scene.still_at(time))
                if ply != paths[-1]:
                    _convert(ply, paths[-1])
                bar.update(len(paths))
    return paths


def _convert(ply: Path, path: Path) -> None:
    program = shutil.which(CONVERTER) or CONVERTER
    done = subprocess.run([program, "-q", "-w", "-g", "cpu", str(ply), str(path)], capture_output=True, text=True)
    if done.returncode or not path.is_file():
        raise D2Error(f"{CONVERTER} cannot write {path} ({done.stderr[-300:].strip()}): choose --format ply")


CONVERTED = ("sog", "spz", "glb")  # by CONVERTER
FRAME_FORMATS = ("ply", *CONVERTED)  # of single instants

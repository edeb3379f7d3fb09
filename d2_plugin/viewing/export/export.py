"""`d2 export`: a trained run as files that others open; see `FORMATS`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from d2_plugin.durable import make_folder, refuse_foreign, remove_leftovers
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.progress import progress_bar
from d2_plugin.settings import Count, Downscale, Positional, Range, Settings
from d2_plugin.viewing.checkpoints import open_viewed
from d2_plugin.viewing.export.coded import seen_rows
from d2_plugin.viewing.export.page import GENERATOR, write_page
from d2_plugin.viewing.export.ply import write_ply
from d2_plugin.viewing.export.scene import ExportScene, export_scene
from d2_plugin.viewing.export.splatv import fit_curves, write_splatv
from d2_plugin.viewing.export.spz import write_spz


@dataclass(frozen=True)
class Export(Settings):
    """Which run is exported, as what."""

    run_folder: Annotated[Path, Positional()]
    """The --output of `d2 train`; or what an official trainer wrote, with --recording."""
    format: Literal["html", "ply", "spz", "splatv"] = "html"
    """html: one page that plays the scene without a network. ply, spz: a file for each frame. splatv: the moving scene
    for splaTV and gsplat.js."""
    output: Path | None = None
    """Folder to write into; `export` inside the run's folder if not given."""
    frames: tuple[Count, ...] | None = None
    """first:last or first:last:step, the last one included, of ply and spz; all frames if not given."""
    megabytes: Annotated[float, Range(1e-3, 1e6)] = 40.0
    """Size of an html page that key times of a deformation field, or harmonics in 8 bits, may bring it to."""
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
            f"--frames is for {' and '.join(FRAME_FORMATS)}: {settings.format} holds the whole clip, leave it out"
        )
    path = settings.run_folder
    viewed = open_viewed(path, settings.recording, settings.train_cameras, settings.downscale)
    output = settings.output or (path.parent if path.is_file() else path) / "export"
    paths, notes = write_export(export_scene(viewed), settings, output)
    what = f"{len(paths)} files in {paths[0].parent}" if len(paths) > 1 else str(paths[0])
    size = sum(path.stat().st_size for path in paths) / 1e6
    return "\n".join([f"{what} ({size:.1f} MB)", *([viewed.note] if viewed.note else []), *notes])


def write_export(scene: ExportScene, settings: Export, folder: Path) -> Written:
    """Write the scene under `folder` in the format that the settings name."""
    with only_writer(make_folder(folder)):
        remove_leftovers(folder)
        paths, notes = FORMATS[settings.format](scene, settings, folder)
    if scene.background is not None and settings.format != "html":
        notes = [*notes, "the background behind the Gaussians is left out: the format has no place for it, html has"]
    return paths, notes


def _html(scene: ExportScene, settings: Export, folder: Path) -> Written:
    path = folder / "scene.html"
    refuse_foreign(path, f'content="{GENERATOR} ', "d2 export")
    return [path], write_page(scene, path, settings.megabytes)


def _splatv(scene: ExportScene, settings: Export, folder: Path) -> Written:
    path, notes, bends = folder / "scene.splatv", [], None
    if scene.moving is not None:
        shown = scene.moving.select(seen_rows(scene.moving, scene.duration))
    else:
        shown, bends, offset = fit_curves(scene)
        notes.append(f"one cubic curve for each Gaussian: off by {offset}")
    write_splatv(path, shown, scene.duration, (*scene.train_cameras, *scene.test_cameras), bends)
    if shown.harmonics.degree > 0:
        notes.append("one colour for every direction: the format has no harmonics")
    if shown.harmonics.time_degree:
        notes.append("colours stand still, as they are at each Gaussian's mean time")
    return [path], notes


def _frame_files(scene: ExportScene, settings: Export, folder: Path) -> Written:
    """One file of Gaussians that stand still for each frame."""
    chosen = scene.frames if settings.frames is None else settings.frames
    for frame in chosen:
        if frame not in scene.frames:
            first, last = scene.frames[0], scene.frames[-1]
            raise D2Error(f"the run has no frame {frame}: it has {first} to {last}; name some of those in --frames")
    if not chosen:
        raise D2Error("--frames names no frame: give first:last, or leave it out for all of them")
    make_folder(folder / settings.format)
    paths, writer = list[Path](), write_spz if settings.format == "spz" else write_ply
    with progress_bar(settings.format, len(set(chosen))) as bar:
        for frame, time in zip(scene.frames, scene.seconds):
            if frame in chosen:
                paths.append(folder / settings.format / f"frame_{frame:05d}.{settings.format}")
                writer(paths[-1], *scene.still_at(time))
                bar.update(len(paths))
    return paths, []


FORMATS = {"html": _html, "ply": _frame_files, "spz": _frame_files, "splatv": _splatv}
"""By the name of the format; a new one is a function here and a word in `Export.format`."""
FRAME_FORMATS = ("ply", "spz")

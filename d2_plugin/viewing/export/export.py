"""`d2 export`: a trained run as files that others open; see `FORMATS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from torch import Tensor

from d2_plugin.durable import make_folder, remove_leftovers
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.locks import only_writer
from d2_plugin.progress import progress_bar
from d2_plugin.runs.gaussian_ply import write_ply
from d2_plugin.runs.run import Run
from d2_plugin.settings import AtLeastOne, Count, Positional, Positive, Settings
from d2_plugin.viewing.checkpoints import is_output_folder
from d2_plugin.viewing.export.coded_scene import seen_rows
from d2_plugin.viewing.export.curves import fit_curves
from d2_plugin.viewing.export.linear_files import read_ftgs, read_splatv, write_ftgs, write_splatv
from d2_plugin.viewing.export.of_checkpoint import scene_of_checkpoint
from d2_plugin.viewing.export.page import write_page
from d2_plugin.viewing.export.rounding import rounding, states_of
from d2_plugin.viewing.export.scene import ExportScene, scene_of
from d2_plugin.viewing.export.spz import write_spz

Shapes = tuple[Tensor, Tensor]
"""Scales [M, 3] and quaternions [M, 4]."""


@dataclass(frozen=True)
class Export(Settings):
    """Which run is exported, as what."""

    run_folder: Annotated[Path, Positional()]
    """The --output of `d2 train`; or what an official trainer wrote, with --recording."""
    format: Literal["html", "ply", "spz", "splatv", "ftgs"] = "html"
    """html: one page that plays the scene without a network. ply, spz: a file for each frame. splatv: the moving scene
    for splaTV and gsplat.js. ftgs: the same without loss, as .ftgs.ply; 4D Gaussians only."""
    output: Path | None = None
    """Folder to write into; `export` inside the run's folder if not given."""
    frames: tuple[Count, ...] | None = None
    """first:last or first:last:step, the last one included, of ply and spz; all frames if not given."""
    megabytes: Positive = 40.0
    """Size of an html page that key times of a deformation field, or harmonics in 8 bits, may bring it to."""
    unfinished: bool = False
    """Export a run that has not been trained to its end."""
    recording: Path | None = None
    """The recording of a checkpoint of an official trainer."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with; all but these are held out."""
    downscale: AtLeastOne = 1
    """For such a checkpoint: the recording's cameras with images this many times smaller."""


class Made(NamedTuple):
    """What a format has written, and what is to be said about it."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Bytes of all files together."""
        return sum(path.stat().st_size for path in self.paths)


def run(settings: Export) -> str:
    """Write the export; returns what was written, how large it is, and how far off."""
    scene, note = _scene(settings)
    if settings.frames is not None and settings.format not in FRAME_FORMATS:
        raise D2Error(
            f"--frames is for {' and '.join(FRAME_FORMATS)}: {settings.format} holds the whole clip, leave it out"
        )
    made = export_scene(scene, settings, settings.output or _beside(settings.run_folder) / "export")
    what = str(made.paths[0]) if len(made.paths) == 1 else f"{len(made.paths)} files in {made.paths[0].parent}"
    return "\n".join([f"{what} ({made.size / 1e6:.1f} MB)", *([note] if note else []), *made.notes])


def _scene(settings: Export) -> tuple[ExportScene, str]:
    """What is exported, and what a person should know of it."""
    path = settings.run_folder
    if path.is_file() or is_output_folder(path):
        return scene_of_checkpoint(path, settings.recording, settings.train_cameras, settings.downscale)
    return scene_of(Run.load(path), settings.unfinished), ""


def _beside(path: Path) -> Path:
    return path.parent if path.is_file() else path


def export_scene(scene: ExportScene, settings: Export, folder: Path) -> Made:
    """Write the scene under `folder` in the format that the settings name."""
    with only_writer(make_folder(folder)):
        remove_leftovers(folder)
        made = FORMATS[settings.format](scene, settings, folder)
    if scene.background is None or settings.format == "html":
        return made
    return made._replace(
        notes=(*made.notes, "the background behind the Gaussians is left out: the format has no place for it, html has")
    )


def _html(scene: ExportScene, settings: Export, folder: Path) -> Made:
    page = write_page(scene, folder / "scene.html", settings.megabytes)
    return Made((folder / "scene.html",), page.about)


def _splatv(scene: ExportScene, settings: Export, folder: Path) -> Made:
    path, duration, cameras = folder / "scene.splatv", scene.clip.duration, (*scene.train_cameras, *scene.test_cameras)
    if scene.moving is not None:
        shown = _shown(scene)
        write_splatv(path, shown, duration, cameras)
        read = read_splatv(path, duration)
        return Made(
            (path,), (f"16-bit floats: off by {rounding(scene, states_of(shown), states_of(read))}", *_colors(shown))
        )
    curves = fit_curves(scene)
    write_splatv(path, curves.gaussians, duration, cameras, curves.bends)
    return Made((path,), (f"one cubic curve for each Gaussian: off by {curves.offset}", *_colors(curves.gaussians)))


def _ftgs(scene: ExportScene, settings: Export, folder: Path) -> Made:
    path, duration = folder / "scene.ftgs.ply", scene.clip.duration
    if scene.moving is None:
        raise D2Error(
            "ftgs holds straight lines only, and this run has a deformation field: take --format html or splatv"
        )
    shown = _shown(scene)
    write_ftgs(path, shown, duration, len(scene.clip.frames))
    off = rounding(scene, states_of(shown), states_of(read_ftgs(path, duration)))
    return Made((path,), (f"32-bit floats: off by {off}", *_colors(shown, harmonics=True)))


def _ply(scene: ExportScene, settings: Export, folder: Path) -> Made:
    def write(path: Path, shown: MovingGaussians, shapes: Shapes) -> None:
        coefficients = shown.harmonics.coefficients
        parts = shown.positions, shown.covariances, SH_C0 * coefficients[:, 0] + 0.5, shown.opacities
        write_ply(path, *parts, coefficients[:, 1:], shapes=shapes)

    return _each_frame(scene, settings, folder, write)


def _spz(scene: ExportScene, settings: Export, folder: Path) -> Made:
    return _each_frame(scene, settings, folder, write_spz)


def _each_frame(
    scene: ExportScene, settings: Export, folder: Path, write: Callable[[Path, MovingGaussians, Shapes], object]
) -> Made:
    clip = scene.clip if settings.frames is None else scene.restricted(settings.frames)
    make_folder(folder / settings.format)
    paths = []
    with progress_bar(settings.format, len(clip.frames)) as bar:
        for frame, time in zip(clip.frames, clip.seconds):
            paths.append(folder / settings.format / f"frame_{frame:05d}.{settings.format}")
            splats = scene.splats_at(time)
            write(paths[-1], scene.still(splats, time), scene.shapes(splats))
            bar.update(len(paths))
    return Made(tuple(paths))


def _shown(scene: ExportScene) -> MovingGaussians:
    """The moving Gaussians that are seen at all."""
    assert scene.moving is not None
    return scene.moving.select(seen_rows(scene.moving, scene.clip.duration))


def _colors(shown: MovingGaussians, harmonics: bool = False) -> tuple[str, ...]:
    """What is lost of the colours in a format with or without harmonics."""
    flat = not harmonics and shown.harmonics.degree > 0
    notes = ("one colour for every direction: the format has no harmonics",) if flat else ()
    still = ("colours stand still, as they are at each Gaussian's mean time",) if shown.harmonics.time_degree else ()
    return (*notes, *still)


FORMATS: dict[str, Callable[[ExportScene, Export, Path], Made]] = {
    "html": _html,
    "ply": _ply,
    "spz": _spz,
    "splatv": _splatv,
    "ftgs": _ftgs,
}
"""By the name of the format; a new one is a function here and a word in `Export.format`."""
FRAME_FORMATS = ("ply", "spz")

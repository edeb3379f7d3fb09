"""`d2 render`: a video of one run, or of several beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.checks.memory import check_bytes
from d2_plugin.runs.drawing import GAP, Panel, side_by_side
from d2_plugin.settings import AtLeastOne, Positional, Range, Settings
from d2_plugin.viewing.checkpoints import open_subject
from d2_plugin.viewing.look import look
from d2_plugin.viewing.panels import KINDS, Scale, Shot, depth_scale
from d2_plugin.viewing.subject import Subject, size_of
from d2_plugin.viewing.videos.plan import Plan, Stop, Wishes, plan_video
from d2_plugin.viewing.videos.video import RATES, Format, pyav, write_video

BYTES_PER_PIXEL, BYTES_PER_PANEL = 60, 40
"""Of a video at its peak: of drawing one panel, and of each panel that is kept until the image is whole."""

SAMPLED = 5
"""Images of a video from which the range of depths is taken."""


@dataclass(frozen=True)
class RenderSettings(Settings):
    """What is shown, from where, when, and how it is written."""

    runs: Annotated[tuple[Path, ...], Positional()]
    """Folders of `d2 train`, shown beside each other; or checkpoints of official trainers, with --recording."""
    output: Path | None = None
    """File of the video, or folder of its PNGs; by default in videos/ of the first run."""
    path: str = "held-out"
    """Where the camera stands: held-out (each held-out camera in turn), training (each training camera), or where it
    moves: orbit, spiral, through (the training cameras), or a nerfstudio camera_path.json."""
    show: tuple[str, ...] = ("rgb",)
    """Images beside each other, joined by commas: rgb, depth, alpha, count (Gaussians per pixel); at the recording's
    cameras also truth, error, true-depth, and from the depth prior: prior, sigma, labels."""
    cameras: tuple[str, ...] | None = None
    """Cameras of the path; by default all held-out or all training cameras."""
    at: Annotated[float, Range(0, unit="seconds")] | None = None
    """Freeze time at this instant while the camera moves."""
    speed: Annotated[float, Range(1e-6, 1e6)] = 1.0
    """Of time in the recording: 0.25 is slow motion, with images between the recorded frames."""
    seconds: Annotated[float, Range(0, unit="seconds", open_low=True)] | None = None
    """Length of the video, for each camera where it stands; by default that of the recording, and at least 6 where the
    camera moves. Time runs back and forth in a video that is longer than the recording."""
    fps: Annotated[float, Range(*RATES, unit="images per second")] | None = None
    """Of the video; by default those of the recording."""
    degrees: Annotated[float, Range(0, 360, unit="degrees", open_low=True)] | None = None
    """Angle that an orbit swings; by default what the training cameras span, since nobody saw the rest."""
    width: Annotated[int, Range(1, 16384, unit="pixels")] | None = None
    """Width of each image; by default the camera's."""
    height: Annotated[int, Range(1, 16384, unit="pixels")] | None = None
    """Height of each image; by default the camera's, or in proportion to the width."""
    format: Format = "mp4"
    """mp4 (H.264 that browsers play), webp or gif (animated, in loops), png (one file per image)."""
    quality: Annotated[int, Range(0, 51)] = 18
    """Constant rate factor of mp4, 0 is lossless; the quality of webp is 100 less twice this."""
    no_captions: bool = False
    """Leave out the line above images that says what they are."""
    recording: Path | None = None
    """The recording of a checkpoint of an official trainer."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with; all but these are held out."""
    downscale: AtLeastOne = 1
    """For such a checkpoint: make the recording's images this many times smaller."""


def run(settings: RenderSettings) -> str:
    """Draw and write the video; returns where it is and what it shows."""
    _check(settings)
    subjects = [
        open_subject(path, settings.recording, settings.train_cameras, settings.downscale) for path in settings.runs
    ]
    plan = plan_video(subjects[0], _wishes(settings))
    size = size_of(plan.stops[0].pose.lens, settings.width, settings.height)
    _check_memory(size, len(settings.show) * len(subjects))
    path = settings.output or _default_output(settings)
    depths = _depths(subjects, plan, size, settings.show)
    captions = not settings.no_captions
    with write_video(path, settings.format, plan.fps, settings.quality) as video:
        whole = (0, 0)
        with progress_bar("render", len(plan.stops)) as bar:
            for done, image in enumerate(_images(subjects, plan, size, settings.show, depths, captions), start=1):
                video.add(image)
                whole = image.shape[1], image.shape[0]
                bar.update(done)
    notes = [f"note  {subject.note}" for subject in subjects if subject.note]
    seconds = len(plan.stops) / plan.fps
    said = f"{path}: {len(plan.stops)} images of {whole[0]}x{whole[1]}, {plan.fps:g} per second, {seconds:.3g} s"
    if settings.format == "mp4" and (whole[0] % 2 or whole[1] % 2):
        said += f"; the file has {whole[0] + whole[0] % 2}x{whole[1] + whole[1] % 2}, since H.264 needs even sides"
    return "\n".join([*notes, said])


def _check(settings: RenderSettings) -> None:
    """Refuse before anything is opened what cannot be drawn."""
    if not settings.runs:
        raise D2Error("d2 render needs RUN: give the --output folder of `d2 train`")
    if not settings.show:
        raise D2Error(f"--show names nothing: have {', '.join(KINDS)}")
    for name in settings.show:
        if name not in KINDS:
            raise unknown_name("image", name, KINDS)
    recorded = [name for name in settings.show if KINDS[name].needs != "gaussians"]
    if recorded and settings.path not in ("held-out", "training"):
        raise D2Error(
            f"--show {recorded[0]} is known at the recording's cameras only: choose --path held-out or training"
        )
    if settings.format != "png":
        pyav()


def _check_memory(size: tuple[int, int], panels: int) -> None:
    """Refuse images that this machine has too little memory for."""
    needed = size[0] * size[1] * (BYTES_PER_PIXEL + BYTES_PER_PANEL * panels)
    check_bytes(needed, f"images of {size[0]}x{size[1]} pixels", "choose a smaller --width and --height")


def _wishes(settings: RenderSettings) -> Wishes:
    recorded = any(KINDS[name].needs != "gaussians" for name in settings.show)
    names = ("path", "cameras", "at", "speed", "seconds", "fps", "degrees")
    return Wishes(**{name: getattr(settings, name) for name in names}, recorded_instants=recorded)


def _default_output(settings: RenderSettings) -> Path:
    """RUN/videos/PATH_WHAT.mp4; for several runs beside the first run's folder."""
    first = settings.runs[0]
    folder = (first if first.is_dir() else first.parent) / "videos"
    name = "_".join([Path(settings.path).stem, *settings.show, *(["frozen"] if settings.at is not None else [])])
    if len(settings.runs) > 1:
        name = f"{name}_{'_'.join(path.stem for path in settings.runs)}"
    return folder / (name if settings.format == "png" else f"{name}.{settings.format}")


def _images(
    subjects: Sequence[Subject],
    plan: Plan,
    size: tuple[int, int],
    show: Sequence[str],
    depths: Scale,
    captions: bool,
) -> Iterator[np.ndarray]:
    for stop in plan.stops:
        named = len(subjects) > 1
        yield arranged([_panels(subject, stop, size, show, depths, named) for subject in subjects], captions)


def _panels(
    subject: Subject, stop: Stop, size: tuple[int, int], show: Sequence[str], depths: Scale, named: bool
) -> list[Panel]:
    shot = Shot(subject, subject.view(stop.pose, stop.time, size, stop.camera), depths)
    panels = [KINDS[name].draw(shot) for name in show]
    if not named:
        return panels
    return [panel._replace(caption=_named(subject.name, panel.caption)) for panel in panels]


def _named(name: str, caption: str) -> str:
    """The caption with the name of its run, except where every run has the same image."""
    if caption.startswith(("recorded", "true depth")):
        return caption
    return name if caption == "render" else f"{name}: {caption}"


def arranged(rows: Sequence[Sequence[Panel]], captions: bool = True) -> np.ndarray:
    """One image of all panels: one row for each run, or a single row where each has one panel.

    A single render stands alone, without a caption: the video then has exactly its size.
    """
    if len(rows) > 1 and all(len(row) == 1 for row in rows):
        rows = [[panel for row in rows for panel in row]]
    if len(rows) == 1 and len(rows[0]) == 1 and rows[0][0].bar is None:
        return rows[0][0].image
    if captions:
        drawn = [side_by_side(row) for row in rows]
    else:
        drawn = [_joined([panel.image for panel in row], axis=1) for row in rows]
    return _joined(drawn, axis=0)


def _joined(images: Sequence[np.ndarray], axis: int) -> np.ndarray:
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.zeros(shape, np.uint8)
    parts = [part for image in images for part in (gap, image)]
    return np.concatenate(parts[1:], axis=axis)


def _depths(subjects: Sequence[Subject], plan: Plan, size: tuple[int, int], show: Sequence[str]) -> Scale:
    """The range of depths of a video, from a few of its images; not computed where none is shown."""
    if not {"depth", "true-depth", "prior"} & set(show):
        return 0.0, 1.0
    chosen = np.unique(np.linspace(0, len(plan.stops) - 1, SAMPLED).round().astype(int))
    small = max(size[0] // 2, 1), max(size[1] // 2, 1)
    found = []
    for subject in subjects:
        views = [subject.view(plan.stops[i].pose, plan.stops[i].time, small) for i in chosen]
        found += [look(subject.backbone, view).depth.numpy() for view in views]
    return depth_scale(found)

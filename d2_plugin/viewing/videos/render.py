"""`d2 render`: a video of one run, or of several beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.extras import import_av
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.checks.memory import check_bytes
from d2_plugin.recordings.selection import spread
from d2_plugin.runs.drawing import GAP, Panel, Scale, depth_scale, side_by_side
from d2_plugin.values import counted
from d2_plugin.viewing.checkpoints import open_viewed
from d2_plugin.viewing.panels import KINDS, Shot
from d2_plugin.viewing.rendering import render_view
from d2_plugin.viewing.videos.plan import Plan, RenderSettings, Stop, plan_video
from d2_plugin.viewing.videos.video import write_video
from d2_plugin.viewing.viewed import ViewedRun

BYTES_PER_PIXEL, BYTES_PER_PANEL = 60, 40
"""Of a video at its peak: of drawing one panel, and of each panel that is kept until the image is whole."""

SAMPLED = 5
"""Images of a video from which the range of depths is taken."""


def run(settings: RenderSettings) -> str:
    """Write the video; returns where it is and what it holds."""
    _check(settings)
    checkpoint = settings.recording, settings.train_cameras, settings.downscale
    runs = [open_viewed(path, *checkpoint) for path in settings.runs]
    plan = plan_video(runs[0], settings)
    size = _size(plan.stops[0], settings.width, settings.height)
    needed = size[0] * size[1] * (BYTES_PER_PIXEL + BYTES_PER_PANEL * len(settings.show) * len(runs))
    check_bytes(needed, f"images of {size[0]}x{size[1]} pixels", "choose a smaller --width and --height")
    path = settings.output
    if path is None:  # RUN/videos/PATH_WHAT.mp4; for several runs in the first one's folder
        first, several = settings.runs[0], [run.stem for run in settings.runs] if len(runs) > 1 else []
        frozen = ["frozen"] if settings.at is not None else []
        name = "_".join([Path(settings.path).stem, *settings.show, *frozen, *several])
        folder = (first if first.is_dir() else first.parent) / "videos"
        path = folder / (name if settings.format == "png" else f"{name}.{settings.format}")
    depths = _depths(runs, plan, size, settings.show)
    with (
        write_video(path, settings.format, plan.fps, settings.quality) as add,
        progress_bar("render", len(plan.stops)) as bar,
    ):
        for done, stop in enumerate(plan.stops, start=1):
            rows = [_panels(viewed, stop, size, settings.show, depths, len(runs) > 1) for viewed in runs]
            image = arranged(rows, not settings.no_captions)
            add(image)
            bar.update(done)
    height, width = image.shape[:2]
    notes = [f"note  {viewed.note}" for viewed in runs if viewed.note]
    seconds = len(plan.stops) / plan.fps
    summary = (
        f"{path}: {counted(len(plan.stops), 'image')} of {width}x{height}, {plan.fps:g} per second, {seconds:.3g} s"
    )
    if settings.format == "mp4" and (width % 2 or height % 2):
        summary += f"; the file has {width + width % 2}x{height + height % 2}, since H.264 needs even sides"
    return "\n".join([*notes, summary])


def _check(settings: RenderSettings) -> None:
    if not settings.runs:
        raise D2Error("d2 render needs RUN: give the --output folder of `d2 train`")
    if not settings.show:
        raise D2Error(f"--show names nothing: have {', '.join(KINDS)}")
    refuse_unknown("image", settings.show, KINDS)
    if settings.recorded and settings.path not in ("held-out", "training"):
        raise D2Error(
            f"--show {settings.recorded[0]} is known at the recording's cameras only: choose --path held-out or "
            "training"
        )
    if settings.format != "png":
        import_av("writing videos")


def _size(first: Stop, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of an image: as given, the other side in proportion, by default the camera's own."""
    lens = first.camera
    if width is None and height is None:
        return lens.width, lens.height
    if height is None:
        return int(width or 1), max(round(lens.height * (width or 1) / lens.width), 1)
    return (max(round(lens.width * height / lens.height), 1) if width is None else width), height


def _panels(
    viewed: ViewedRun, stop: Stop, size: tuple[int, int], show: Sequence[str], depths: Scale, named: bool
) -> list[Panel]:
    """The panels of one run at one image; `named` puts the run's name into captions that differ from run to run."""
    shot = Shot(viewed, viewed.view(stop.camera, stop.time, size), depths)
    panels = [KINDS[name](shot) for name in show]
    if not named:
        return panels
    own = [name not in ("truth", "true-depth") for name in show]
    captions = [viewed.name if panel.caption == "render" else f"{viewed.name}: {panel.caption}" for panel in panels]
    return [p._replace(caption=c) if is_own else p for p, c, is_own in zip(panels, captions, own, strict=True)]


def arranged(rows: Sequence[Sequence[Panel]], captions: bool) -> np.ndarray:
    """One image of all panels: one row for each run, or a single row where each has one panel.

    A single render stands alone, without a caption: the video then has exactly its size.
    """
    if len(rows) > 1 and all(len(row) == 1 for row in rows):
        rows = [[panel for row in rows for panel in row]]
    if len(rows) == 1 and len(rows[0]) == 1 and rows[0][0].bar is None:
        return rows[0][0].image
    drawn = [side_by_side(row) if captions else _joined([panel.image for panel in row], axis=1) for row in rows]
    return _joined(drawn, axis=0)


def _joined(images: Sequence[np.ndarray], axis: int) -> np.ndarray:
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.zeros(shape, np.uint8)
    parts = [part for image in images for part in (gap, image)]
    return np.concatenate(parts[1:], axis=axis)


def _depths(runs: Sequence[ViewedRun], plan: Plan, size: tuple[int, int], show: Sequence[str]) -> Scale:
    """The range of depths of a video, from a few of its images; not computed where none is shown."""
    if not {"depth", "true-depth"} & set(show):
        return 0.0, 1.0
    small = max(size[0] // 2, 1), max(size[1] // 2, 1)
    stops = spread(plan.stops, SAMPLED)
    views = [(viewed, viewed.view(stop.camera, stop.time, small)) for viewed in runs for stop in stops]
    return depth_scale([render_view(viewed.backbone, view).depth.numpy() for viewed, view in views])

"""Scores of a trained model at cameras it has not seen, and images that show them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.durable import make_folder
from d2_plugin.errors import D2Error
from d2_plugin.hooks.densify import rendered_depth
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.images import color_bytes, write_png
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.runs import metrics
from d2_plugin.runs.drawing import Panel, depth_panel, depth_scale, error_panel, side_by_side
from d2_plugin.runs.lpips import SMALLEST, Lpips, find_lpips
from d2_plugin.runs.plan import CHANGED, MOVING_SHARE
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.start import make_view

RenderView = Callable[[str, int], tuple[Tensor, Tensor | None]]
"""(camera name, frame) -> (RGB [H, W, 3] in 0..1, planar depth [H, W] or None).

The depth is 0 where the model has too little opacity to have one. Such a pixel counts as wrong wherever there is true
depth (see `metrics.depth_absrel`), so leaving depth out never improves a score.
"""

Progress = Callable[[int, int], None]
"""(views done, views in total)."""

BETWEEN = ("psnr", "psnr_moving")
"""Metrics whose means over instants between the trained ones stand apart."""

RENDERED_ALPHA = 0.5
"""A rendered depth is reported where the accumulated alpha exceeds this."""


def renderer(model: Any, recording: Recording, device: torch.device | str) -> RenderView:
    """Colour [H, W, 3] and depth [H, W] of a model, 0 where too little is opaque, on the CPU."""

    @torch.no_grad()
    def render(camera: str, frame: int) -> tuple[Tensor, Tensor]:
        view = make_view(recording, camera, frame, device)
        color, depth_sum, alpha = (part.cpu() for part in model.render(view)[:3])
        return color.clamp(0, 1), rendered_depth(depth_sum, alpha, RENDERED_ALPHA)[0]

    return render


def evaluate_scene(model: Any, scene: Scene, device: torch.device | str, images: Path | None = None) -> dict[str, Any]:
    """`evaluate` at the test cameras of a scene; at its training cameras, under `train` instead of `test`, where it has
    none."""
    recording, cameras = scene.scored, scene.test_cameras or scene.train_cameras
    frames, lenses = recording.frames, [recording.cameras[name] for name in cameras]
    large = min(min(camera.width, camera.height) for camera in lenses) >= SMALLEST
    alex, vgg = (find_lpips(net) if large else None for net in ("alex", "vgg"))
    with progress_bar("evaluate", len(cameras) * len(frames)) as bar:
        scores = evaluate(
            renderer(model, recording, device),
            *(recording, cameras, frames, images),
            between=scene.between,
            lpips=alex,
            lpips_vgg=vgg,
            progress=lambda done, _: bar.update(done),
        )
    return scores if scene.test_cameras else {"test": None, "train": scores.pop("test")} | scores


def evaluate(
    render: RenderView,
    recording: Recording,
    cameras: Sequence[str],
    frames: Iterable[int],
    output: Path | None = None,
    *,
    between: Collection[int] = (),
    lpips: Lpips | None = None,
    lpips_vgg: Lpips | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare renders with the recording's images, one view at a time.

    With any renderer of your own:

        scores = evaluate(my_render, open_recording("studio"), ["01", "03"], range(20))
        scores["test"]["psnr"]

    Args:
        render: draws one view; colours are clamped to 0..1 here.
        cameras, frames: what to compare: every camera at every frame.
        output: folder for one image per view, `<camera>_<frame>.png`: truth, render, rendered depth and error side
            by side (and true depth where there is one). No images where None.
        between: frames that were not trained, between others that were. The means leave them out; `psnr` and
            `psnr_moving` over them stand beside the means as `psnr_between` and `psnr_moving_between`.
        lpips, lpips_vgg: from `find_lpips`, on AlexNet and on VGG16; a score is null where its network is None.

    Returns:
        {"test": mean of each metric over the views that have it (null where none has),
        "per_view": [{"camera", "frame", metric: value, ...}], "per_frame": [{"frame", mean over cameras}],
        "per_camera": [{"camera", mean over frames}], "variants": {metric: definition}}. The first frame of a camera
        has no flicker, the others are compared with the frame before them in `frames`.

    Raises:
        D2Error: a render of another size than the camera's or with values that are not finite.
    """
    instants = list(frames)
    views = [(camera, frame) for camera in cameras for frame in instants]
    if not views:
        raise D2Error("nothing to evaluate: give at least one camera and one frame")
    if output is not None:
        make_folder(output)
    rows: list[dict[str, Any]] = []
    networks = {"lpips": lpips, "lpips_vgg": lpips_vgg}
    still: np.ndarray | None = None  # what the camera sees where nothing moves
    before: tuple[str, Tensor, Tensor] | None = None  # camera, render and truth of the view before
    recorded: np.ndarray | None = None  # what counts of the camera's images
    for done, (camera, frame) in enumerate(views, start=1):
        if before is None or before[0] != camera:
            still, before = still_image(recording, camera, instants), None
            recorded = what_counts(recording, camera)
        truth = torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255)
        color, depth = _checked(render(camera, frame), truth.shape, camera, frame)
        color = as_recorded(color, truth, recorded)
        true_depth = recording.depth(camera, frame)
        compared = metrics.Compared(
            *(color, truth, depth, None if true_depth is None else torch.from_numpy(true_depth)),
            what_moves(truth.numpy(), still),
            *(None if before is None else before[1:], networks, _inside(recording, camera, frame), recorded),
        )
        scores = {name: metric.score(compared) for name, metric in metrics.METRICS.items()}
        rows.append({"camera": camera, "frame": frame, **scores})
        before = (camera, color, truth)
        if output is not None:
            panels = _panels(rows[-1], truth.numpy(), color.numpy(), depth, true_depth)
            write_png(output / f"{camera}_{frame:05d}.png", side_by_side(panels))
        if progress is not None:
            progress(done, len(views))
    trained = [row for row in rows if row["frame"] not in between]
    apart = [row for row in rows if row["frame"] in between]
    means, variants = _means(trained), dict(metrics.VARIANTS)
    for name in BETWEEN if apart else ():
        means[f"{name}_between"] = _mean(row[name] for row in apart)
        variants[f"{name}_between"] = f"at instants between trained ones: {metrics.VARIANTS[name]}"
    groups = {"per_frame": _grouped(rows, "frame"), "per_camera": _grouped(trained, "camera")}
    return {"test": means, "per_view": rows, **groups, "variants": variants}


def still_image(recording: Recording, camera: str, frames: Sequence[int]) -> np.ndarray | None:
    """What a camera sees where nothing moves, [H, W, 3] in 0..1: the median of up to nine frames spread in time.

    None where there are fewer than three frames: the median of two is neither.
    """
    if len(frames) < 3:
        return None
    return np.median([recording.image(camera, f) for f in spread(frames, 9)], axis=0).astype(np.float32) / 255


def what_moves(image: np.ndarray, still: np.ndarray | None) -> np.ndarray | None:
    """The pixels [H, W] of an image [H, W, 3] in 0..1 that differ from what its camera sees where nothing moves; None
    where nearly none do, or that is not known."""
    moving = None if still is None else np.abs(image - still).max(-1) > CHANGED
    return moving if moving is not None and moving.mean() > MOVING_SHARE else None


def what_counts(recording: Recording, camera: str) -> np.ndarray | None:
    """The pixels [H, W] of a camera's images that were recorded, by which it is scored; None where all are."""
    recorded, rim = recording.recorded(camera), metrics.UNIFORM_WINDOW // 2
    return recorded if recorded is not None and recorded[rim:-rim, rim:-rim].any() else None


def as_recorded(image: Tensor, truth: Tensor, recorded: np.ndarray | None) -> Tensor:
    """An image [H, W, 3] with the black of the truth where undistorting left nothing: that nobody can have drawn."""
    return image if recorded is None else torch.where(torch.from_numpy(recorded)[..., None], image, truth)


def _inside(recording: Recording, camera: str, frame: int) -> np.ndarray | None:
    """The pixels [H, W] of the foreground mask that were recorded; None where there is none."""
    mask, recorded = recording.mask(camera, frame), recording.recorded(camera)
    if mask is None:
        return None
    inside = mask > 0.5 if recorded is None else (mask > 0.5) & recorded
    return inside if inside.any() else None


def _checked(
    rendered: tuple[Tensor, Tensor | None], shape: torch.Size, camera: str, frame: int
) -> tuple[Tensor, Tensor | None]:
    """Colour in 0..1 and depth on the CPU, float32."""
    color = rendered[0].detach().cpu().float()
    depth = None if rendered[1] is None else rendered[1].detach().cpu().float()
    where = f"the render of camera {camera} at frame {frame}"
    if color.shape != shape or (depth is not None and depth.shape != shape[:2]):
        sizes = f"{tuple(color.shape)}" + ("" if depth is None else f" and depth {tuple(depth.shape)}")
        raise D2Error(f"{where} is {sizes}, expected {tuple(shape)}: render at the size of the recording's camera")
    if not torch.isfinite(color).all():
        raise D2Error(f"{where} has values that are not finite: the model has diverged, train it again")
    return color.clamp(0, 1), depth


def _means(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    return {name: _mean(row[name] for row in rows) for name in metrics.VARIANTS}


def _grouped(rows: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """The means of the rows that share a camera or a frame, in the order of their first appearance."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return [{key: value, **_means(group)} for value, group in groups.items()]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _panels(
    row: dict[str, Any], truth: np.ndarray, color: np.ndarray, depth: Tensor | None, true_depth: np.ndarray | None
) -> list[Panel]:
    panels = [
        Panel(f"truth  {row['camera']}  frame {row['frame']}", color_bytes(truth)),
        Panel(f"rendered  {row['psnr']:.2f} dB", color_bytes(color)),
    ]
    score = "" if row["depth_absrel"] is None else f"  AbsRel {row['depth_absrel']:.3f}"
    maps = {"depth": (None if depth is None else depth.numpy(), score), "true depth": (true_depth, "")}
    shown = [(title, array, note) for title, (array, note) in maps.items() if array is not None]
    if shown:
        scale = depth_scale([shown[-1][1]])  # the true one's where there is one
        panels += [depth_panel(title, array, scale, note) for title, array, note in shown]
    return [*panels, error_panel(np.abs(color - truth))]

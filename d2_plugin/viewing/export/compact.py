"""Fewer Gaussians in an export: those that the training images would miss least are removed, the others train on.

Without Gaussian k a pixel differs by o_k dC/do_k, since its colour C is affine in every opacity. The energy of that
difference, summed over an image, is the mean of (o_k d<s, C>/do_k)^2 over images s of random signs (Hutchinson 1990):
one backward pass for a view, for all Gaussians together. Speedy-Splat (Hanson et al. 2025) prunes by a similar sum.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.progress import progress_bar
from d2_plugin.protocol import View
from d2_plugin.rasterizer import rasterize
from d2_plugin.runs.metrics import psnr
from d2_plugin.runs.start import TrainingFrames, make_view
from d2_plugin.viewing.rendering import render_view
from d2_plugin.viewing.viewed import ViewedRun

PROBES, STEPS, PASSES = 80, 300, 4
"""At least so many probes of the energy and so many steps of training, and so many steps for each training image."""


def compacted(viewed: ViewedRun, keep: float) -> ViewedRun:
    """The run with the share `keep` of its Gaussians; its note says what that costs, its scores are measured anew.

    Changes the model of `viewed`.

    Raises:
        D2Error: a checkpoint of another trainer.
    """
    backbone: Any = viewed.backbone
    model: Any = getattr(backbone, "model", None)
    if not hasattr(model, "optimize"):
        raise D2Error(f"--keep trains what it keeps, and {viewed.name} is no run of `d2 train`: leave out --keep")
    frames = TrainingFrames(viewed.recording, viewed.train_cameras, viewed.device, viewed.background_weight)
    generator = torch.Generator().manual_seed(0)
    views, steps = len(frames.views), max(STEPS, PASSES * len(frames.views))
    before, count = _scores(viewed, viewed.train_cameras)[""], len(backbone)
    energies = torch.zeros(count)
    for probe in range(views * -(-PROBES // views)):
        _add_energies(energies, backbone, frames.views[probe % views], generator)
    removed = torch.ones(count, dtype=torch.bool)
    removed[energies.topk(max(round(keep * count), 1)).indices] = False
    backbone.remove(removed.to(viewed.device))
    order: list[int] = []
    with progress_bar("compact", steps) as bar:
        for step in range(1, steps + 1):
            order = order or torch.randperm(views, generator=generator).tolist()
            index = order.pop()
            color = _color(backbone, frames.views[index])
            photometric_loss(color, frames.image_bytes(index), weights=frames.weights(index)).backward()
            model.optimize(steps + step, 2 * steps)  # positions as slowly as in the second half of a run
            bar.update(step)
    after = _scores(viewed, viewed.train_cameras)[""]
    note = f"{len(backbone):,} of {count:,} Gaussians: {after:.2f} dB at the training cameras, {before:.2f} with all"
    scores = _scores(viewed, viewed.test_cameras) if viewed.scores else {}
    if scores:
        note += f"; {scores['']:.2f} dB held out, {viewed.scores['']:.2f} with all"
    return replace(viewed, inserted_at=None, scores=scores, note="\n".join(filter(None, [viewed.note, note])))


def _color(backbone: Any, view: View, opacities: Tensor | None = None) -> Tensor:
    """What a view sees, [H, W, 3]; `opacities` take the place of those of the slice."""
    splats = backbone.slice_at(view)
    colors = backbone.colors(view, splats)
    splats = splats if opacities is None else splats._replace(opacities=opacities)
    color: Tensor = backbone.behind(rasterize(splats, colors, view, backbone.settings), view).color
    return color


def _add_energies(energies: Tensor, backbone: Any, view: View, generator: torch.Generator) -> None:
    """Add to `energies` [N] an estimate of what a view would differ by without each Gaussian."""
    with torch.no_grad():
        _, _, opacities, rows = backbone.slice_at(view)
    opacities.requires_grad_()
    color = _color(backbone, view, opacities)
    signs = torch.randint(0, 2, color.shape, generator=generator).to(color) * 2 - 1
    [gradient] = torch.autograd.grad((signs * color).sum(), opacities)
    energies.index_add_(0, rows.cpu(), (opacities * gradient).detach().cpu().square())


def _scores(viewed: ViewedRun, cameras: tuple[str, ...]) -> dict[str, float]:
    """PSNR of each camera, the mean of its frames, and under "" that of all."""
    recording = viewed.recording

    def score(camera: str, frame: int) -> float:
        color = render_view(viewed.backbone, make_view(recording, camera, frame, viewed.device)).color
        return psnr(color, torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255))

    each = {camera: fmean(score(camera, frame) for frame in recording.frames) for camera in cameras}
    return {"": fmean(each.values())} | each

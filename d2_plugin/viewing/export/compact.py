"""Fewer Gaussians in an export: those that the training images would miss least are removed, the others train on."""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np
import torch

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.progress import progress_bar
from d2_plugin.runs.evaluation import what_counts
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
    energies = torch.zeros(count, device=viewed.device)
    for probe in range(views * -(-PROBES // views)):
        model.add_energies(energies, frames.views[probe % views], generator)
    removed = torch.ones(count, dtype=torch.bool, device=viewed.device)
    removed[energies.topk(max(round(keep * count), 1)).indices] = False
    backbone.remove(removed)
    order: list[int] = []
    with progress_bar("compact", steps) as bar:
        for step in range(1, steps + 1):
            order = order or torch.randperm(views, generator=generator).tolist()
            index = order.pop()
            color = model.render(frames.views[index]).color
            photometric_loss(color, frames.image_bytes(index), weights=frames.weights(index)).backward()
            model.optimize(steps + step, 2 * steps)  # positions as slowly as in the second half of a run
            bar.update(step)
    after = _scores(viewed, viewed.train_cameras)[""]
    note = f"{len(backbone):,} of {count:,} Gaussians: {after:.2f} dB at the training cameras, {before:.2f} with all"
    scores = _scores(viewed, viewed.test_cameras) if viewed.scores else {}
    if scores:
        note += f"; {scores['']:.2f} dB held out, {viewed.scores['']:.2f} with all"
    return replace(viewed, inserted_at=None, scores=scores, note="\n".join(filter(None, [viewed.note, note])))


def _scores(viewed: ViewedRun, cameras: tuple[str, ...]) -> dict[str, float]:
    """PSNR of each camera, the mean of its frames, and under "" that of all."""
    recording = viewed.recording

    def score(camera: str, frame: int) -> float:
        color = render_view(viewed.backbone, make_view(recording, camera, frame, viewed.device)).color
        truth = torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255)
        return psnr(color, truth, what_counts(recording, camera))

    each = {camera: fmean(score(camera, frame) for frame in recording.frames) for camera in cameras}
    return {"": fmean(each.values())} | each

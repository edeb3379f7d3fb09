"""PSNR of what moves at instants that were trained and at those between them, of any trainer: drawn by its adapter.

A trainer's own test set holds the instants that it trains, so the model is asked through the contract, bare and
attached alike, and drawn by our rasterizer.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.trainers.trials import HELD_OUT, TRIALS
from d2_plugin.recordings import open_recording
from d2_plugin.runs.evaluation import evaluate
from d2_plugin.runs.start import make_view
from d2_plugin.viewing.rendering import render_view


def scores(adapted: Callable[[], Any], repository: str, truth: Path) -> dict[str, Any]:
    """Of the held-out cameras; `truth` is what `moving.save_truth` wrote. Nothing where no instant lies between.

    `adapted` makes the adapter of the trained model, where it is needed.
    """
    stored = np.load(truth)
    trained, recording = stored["frames"].tolist(), Path(str(stored["recording"]))
    if len(trained) > trained[-1]:
        return {}
    whole = open_recording(recording, frames=range(trained[-1] + 1), downscale=int(stored["downscale"]))
    backbone = adapted()
    frames, clock, length = whole.frames, TRIALS[repository].clock, len(trained) * (trained[1] - trained[0])

    def render(camera: str, frame: int) -> tuple[Tensor, Tensor]:
        view = make_view(whole, camera, frame)
        if clock == "share":
            view = replace(view, time=frames.index(frame) / length)
        drawn = render_view(backbone, backbone.view(view))
        return drawn.color, drawn.depth

    test = evaluate(render, whole, HELD_OUT, frames, between=set(frames) - set(trained))["test"]
    return {name: test[name] for name in ("psnr_moving", "psnr_moving_between")}

"""PSNR of what moves in the images that an official trainer's own metric compares.

All of them have a function psnr(image, truth). Whatever it is given is matched to the true images of the recording: a
held-out view counts at the pixels that differ from the median of its camera's frames, as everywhere in this project
(`d2_plugin.runs.evaluation`), but of all frames of the recording, since a trial has few. The last comparison counts.
"""

import importlib
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainers.trials import HELD_OUT, TRAINED
from d2_plugin.recordings import open_recording
from d2_plugin.runs.evaluation import still_image
from d2_plugin.runs.metrics import psnr
from d2_plugin.runs.plan import CHANGED, MOVING_SHARE

METRIC = {"spacetime": "thirdparty.gaussian_splatting.utils.image_utils", "gsplat": None}
"""Module of each repository's psnr; of others utils.image_utils. gsplat's script trains one instant: nothing moves."""

OTHER = 0.02
"""Mean difference from the nearest true image, 0..1, beyond which an image is none of the recording's."""


def save_truth(recording: Path, frames: Sequence[int], downscale: int, output: Path) -> Path:
    """The true images [V, H, W, 3] of all cameras at `frames`, where each moves, and which views are held out."""
    whole = open_recording(recording, downscale=downscale)
    images, moving, held_out = [], [], []
    for camera in (*TRAINED, *HELD_OUT):
        still = still_image(whole, camera, list(whole.frames))
        assert still is not None, "a recording has three frames or more"
        for frame in frames:
            images.append(whole.image(camera, whole.frames[frame]))
            moving.append(np.abs(images[-1].astype(np.float32) / 255 - still).max(-1) > CHANGED)
            held_out.append(camera in HELD_OUT)
    np.savez(
        output, images=np.stack(images), moving=np.stack(moving), held_out=np.array(held_out),
        recording=str(recording.resolve()), frames=np.array(frames), downscale=downscale,
    )  # fmt: skip
    return output


class Moving:
    """What a trainer's metric was last given of each held-out view."""

    def __init__(self, truth: Path) -> None:
        stored = np.load(truth)
        self._truth = torch.from_numpy(stored["images"]).float() / 255
        self._moving, self._held_out = stored["moving"], stored["held_out"]
        self._scores: dict[int, float] = {}

    def watch(self, repository: str) -> None:
        """See every comparison from now on; call before the script imports its metric."""
        name = METRIC.get(repository, "utils.image_utils")
        if name is not None:
            module: Any = importlib.import_module(name)
            module.psnr = self._seeing(module.psnr)

    def score(self) -> float | None:
        """The mean over the held-out views in which something moves, dB; None where none was compared."""
        return sum(self._scores.values()) / len(self._scores) if self._scores else None

    def see(self, image: Tensor, truth: Tensor) -> None:
        """One comparison of images [3, H, W] in 0..1."""
        shown, drawn = (part.detach().float().permute(1, 2, 0) for part in (truth, image))
        if shown.shape != self._truth.shape[1:]:
            return
        self._truth = self._truth.to(shown.device)  # fudan compares in every training step
        differences = (self._truth - shown).abs().mean((1, 2, 3))
        nearest = int(differences.argmin())
        moving = self._moving[nearest]
        if differences[nearest] < OTHER and self._held_out[nearest] and moving.mean() > MOVING_SHARE:
            self._scores[nearest] = psnr(drawn.clamp(0, 1).cpu(), self._truth[nearest].cpu(), moving)

    def _seeing(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def seen(image: Tensor, truth: Tensor, *more: Any, **named: Any) -> Any:
            if not torch.is_grad_enabled():
                images, truths = (part.reshape(-1, *part.shape[-3:]) for part in (image, truth))
                for one, other in zip(images, truths):
                    self.see(one, other)
            return original(image, truth, *more, **named)

        return seen

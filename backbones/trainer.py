"""The training loop that both bundled backbones share, and the example that users copy: three lines attach D2.

The loop knows nothing of D2 beyond those lines: `d2` is whatever `attach(model)` returns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.rasterizer import View
from d2_plugin.settings import Seed, Settings, Share, Steps

from .model import SplatModel

DISPENSED = 0.7
"""Share of a run after which Gaussians that the images would hardly miss go; the others make up for them."""
PASSES = 8
"""Steps for each training view from which on that is done: it takes a look or two at each."""

JITTER_FROM = 1000
"""Steps of a run from which on Gaussians stand aside at random: a shorter one has still to find their places."""


class Hooks(Protocol):
    """What the loop needs of D2."""

    def loss(self, step: int, views: Sequence[View]) -> Tensor | float: ...
    def prefetch(self, cameras: Sequence[View]) -> None: ...
    def step(self, step: int) -> Any: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class Frames(Protocol):
    """The training images: views, and the image [H, W, 3] in 0..1 of each.

    Where there is also `image_bytes(index)`, the same as it is kept (uint8, 0..255), the loss is computed from that.
    It may have `weights(index) -> [H, W] | None` as well: how much each pixel counts, 0..1; and `recorded(index)`, bool
    [H, W] or None: which of them the camera recorded.
    """

    views: Sequence[View]

    def image(self, index: int) -> Tensor: ...


@dataclass(frozen=True)
class TrainSettings(Settings):
    """How long and on what loss to train."""

    iterations: Steps = 3000
    """Steps to train."""
    ssim_weight: Share = 0.2
    """Share of D-SSIM in the photometric loss; the rest is L1."""
    seed: Seed = 0
    """Seed of the order of views and of split samples; the global random state is never used."""


class Trainer:
    """One run: model, frames, settings, and the state of the sampler."""

    def __init__(
        self,
        model: SplatModel,
        frames: Frames,
        settings: TrainSettings,
        attach: Callable[[Any], Hooks] | None = None,
    ) -> None:
        self.model, self.frames, self.settings = model, frames, settings
        self.step = 0
        if model.background is not None:
            model.background.start_from(frames.views, frames.image, getattr(frames, "recorded", lambda index: None))
        self.loss: Tensor | None = None
        """The last step's loss with all its terms, for whoever watches that it stays finite."""
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._queue: list[int] = []
        self.d2 = attach(model) if attach else None  # D2, line 1: after the optimizer exists

    def run(self, until: int | None = None, on_step: Callable[[int, float], None] | None = None) -> None:
        """Train up to and including step `until` (default: all); `on_step(step, loss)` reports each one."""
        model, iterations, d2 = self.model, self.settings.iterations, self.d2
        generator = self._generator if iterations >= JITTER_FROM else None
        while self.step < (iterations if until is None else until):
            self.step += 1
            index = self._next_view()
            view = self.frames.views[index]
            render = model.render(view, generator=generator)
            loss = photometric_loss(render.color, self._image(index), self.settings.ssim_weight, self._weights(index))
            logged = loss.item()
            regularization = model.regularization()
            if not isinstance(regularization, float):
                loss = loss + regularization
            if d2 is not None:
                loss = loss + d2.loss(self.step, [view])  # D2, line 2: before backward, never +=
                d2.prefetch([self.frames.views[index] for index in self._queue[-1:]])  # optional: what comes next
            self.loss = loss.detach()
            loss.backward()
            model.accumulate(view)
            model.optimize(self.step, iterations)
            model.densify(self.step, iterations, self._generator)
            if d2 is not None:
                d2.step(self.step)  # D2, line 3: after the optimizer's step and zero_grad
            if self.step == round(DISPENSED * iterations) and iterations >= PASSES * len(self.frames.views):
                model.leave_out_dispensable(iterations, self.frames.views, self.frames.image, self._weights)
            if on_step:
                on_step(self.step, logged)

    def state_dict(self) -> dict[str, Any]:
        """Model, sampler and D2: a run resumed from here is bitwise the uninterrupted one."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "generator": self._generator.get_state(),
            "queue": list(self._queue),
            "d2": self.d2.state_dict() if self.d2 is not None else None,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self.step = state["step"]
        self.model.load_state_dict(state["model"])
        self._generator.set_state(state["generator"].cpu())
        self._queue = list(state["queue"])
        if self.d2 is not None:
            self.d2.load_state_dict(state["d2"])

    def _image(self, index: int) -> Tensor:
        read: Callable[[int], Tensor] = getattr(self.frames, "image_bytes", self.frames.image)
        return read(index)

    def _weights(self, index: int) -> Tensor | None:
        weights: Callable[[int], Tensor | None] | None = getattr(self.frames, "weights", None)
        return None if weights is None else weights(index)

    def _next_view(self) -> int:
        """Every view once, in a new random order each time round."""
        if not self._queue:
            self._queue = torch.randperm(len(self.frames.views), generator=self._generator).tolist()
        return self._queue.pop()

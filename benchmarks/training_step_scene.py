"""What `python -m benchmarks training-step` trains: synthetic Gaussians, images that cost nothing to make, and a
depth prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.raster_measure import upstream
from benchmarks.raster_scenes import FOCAL, synthetic_scene
from d2_plugin import registry
from d2_plugin.config import D2Config
from d2_plugin.hooks import DepthLossConfig
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Label, Points
from d2_plugin.rasterizer import Splats, rasterize
from d2_plugin.recordings import Camera, Recording, Source
from d2_plugin.runs.start import TrainingFrames

RASTER = "rasterizer"
CAMERAS = 4
BASELINE = 0.05
"""Distance between neighbouring cameras, world units: all of them see nearly the same Gaussians."""
FPS = 30.0
DRAWN = 50_000
"""Gaussians that are drawn at random."""
WARM = 80
"""Views whose known pixels are found before a step is timed: a run finds them in its first round."""


class Images(Source):
    """A source of images that are one texture, moved on with every frame: a decoder's work is not measured here."""

    def __init__(self, width: int, height: int) -> None:
        random = np.random.default_rng(0)
        coarse = random.integers(40, 216, (height // 16 + 2, width // 16 + 2, 3), dtype=np.uint8)
        smooth = np.repeat(np.repeat(coarse, 16, 0), 16, 1)[:height, :width]
        self._texture = smooth + random.integers(0, 32, (height, width, 3), dtype=np.uint8)

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        return np.roll(self._texture, 3 * frame + 11 * int(camera), axis=1)


class RandomPrior:
    """D* of any view: nine tenths of the pixels known, three fifths verified; a store as the hooks want it."""

    def __init__(self, width: int, height: int) -> None:
        g = torch.Generator().manual_seed(0)
        draw = torch.rand(height, width, generator=g)
        labels = torch.where(draw < 0.6, int(Label.VERIFIED), int(Label.MONO)).masked_fill(draw > 0.9, int(Label.EMPTY))
        depth = 2 + 8 * torch.rand(height, width, generator=g)
        sigma = torch.where(labels == Label.VERIFIED, 0.005, 0.05)
        self._prior = DepthPrior(depth, labels.to(torch.uint8), sigma=sigma)

    def prior(self, camera: str, frame: int) -> DepthPrior:
        """The same for all views."""
        return self._prior


@dataclass(frozen=True)
class StepScene:
    """The images, and how to make a model of the Gaussians."""

    frames: TrainingFrames
    count: int
    width: int
    height: int

    @classmethod
    def make(cls, gaussians: int, width: int, height: int, frames: int) -> StepScene:
        """Four cameras beside each other, in one plane."""
        K = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]])
        cameras = {}
        for index in range(CAMERAS):
            pose = np.eye(4)
            pose[0, 3] = -BASELINE * (index - (CAMERAS - 1) / 2)
            cameras[str(index)] = Camera(str(index), width, height, K, pose)
        recording = Recording("synthetic", cameras, tuple(range(frames)), FPS, Images(width, height))
        return cls(TrainingFrames(recording, tuple(cameras)), gaussians, width, height)

    def trainer(self, guided: bool) -> Any:
        """A trainer of the native backbone whose Gaussians stay as they are: no density control, steps of no length."""
        backbone: Any = registry.load(registry.BACKBONES, "yang4d")
        duration = max(view.time for view in self.frames.views)
        settings = backbone.settings_from({"densify": {"enabled": False}, "position_rate": 1e-9})
        model = backbone.Yang4D(self._rows(backbone, settings, duration), settings, 5.0, duration)
        # Images and depth are random: what they would teach is another model for each work, and after some hundred
        # steps those with D2 took nearly a fifth longer to draw.
        for group in model.gaussians.optimizer.param_groups:
            group["lr"] = 0.0
        training = backbone.TrainSettings(iterations=1_000_000)
        return backbone.Trainer(model, self.frames, training, self._attach if guided else None)

    def _rows(self, backbone: Any, settings: Any, duration: float) -> dict[str, Tensor]:
        """The rows of `synthetic_scene`; more than `DRAWN` are those again, moved, which takes no minutes to make."""
        scene = synthetic_scene(min(self.count, DRAWN), self.width, self.height)
        copies = torch.arange(self.count) % len(scene.means)
        means, quaternions, sizes, opacities, colors = (part[copies] for part in scene[:5])
        g = torch.Generator().manual_seed(0)
        moved = 0.1 * means[:, 2:] * (torch.rand(self.count, 3, generator=g) - 0.5)
        means = means + moved * (torch.arange(self.count) >= DRAWN)[:, None]
        times, scales = torch.rand(self.count, generator=g) * duration, sizes.mean(1)
        points = Points(means, colors, times, scales, opacities)
        rows: dict[str, Tensor] = backbone.Yang4D.initial_rows(points, settings, duration)
        return rows | {"log_scales": sizes.log(), "left": quaternions, "right": quaternions.clone()}

    def _attach(self, model: object) -> D2Hooks:
        adapter: Any = registry.load(registry.ADAPTERS, "yang4d")
        config = D2Config(depth_loss=DepthLossConfig())
        return D2Hooks(config, adapter(model), store=RandomPrior(self.width, self.height))


def works_of(scene: StepScene) -> dict[str, Callable[[], object]]:
    """The rasterizer's forward and backward on the model's Gaussians, a bare step, and one with the depth loss."""
    bare, guided = scene.trainer(guided=False), scene.trainer(guided=True)
    for view in scene.frames.views[:WARM]:
        guided.d2.prior.known(view)
    return {
        RASTER: _rasterizer(scene, bare.model),
        "step": lambda: bare.run(bare.step + 1),
        "step with D2": lambda: guided.run(guided.step + 1),
    }


def _rasterizer(scene: StepScene, model: Any) -> Callable[[], object]:
    """Gradients of means, covariances, opacities and colours for random ones of colour, depth sum and alpha."""
    view = scene.frames.views[len(scene.frames.views) // 2]
    weights = upstream(scene.height, scene.width, torch.zeros(0))

    def work() -> object:
        with torch.no_grad():
            splats = model.slice_at(view)
            parts = (*splats[:3], model.colors(view, splats))
        leaves = [part.detach().requires_grad_() for part in parts]
        drawn = Splats(leaves[0], leaves[1], leaves[2], splats.rows)
        return torch.autograd.grad(rasterize(drawn, leaves[3], view, model.settings.raster)[:3], leaves, weights)

    return work


def look_at_all(scene: StepScene) -> None:
    """Ask for every image once, as a round of training does."""
    for index in range(len(scene.frames.views)):
        scene.frames.image_bytes(index)

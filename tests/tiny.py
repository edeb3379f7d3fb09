"""A scene small enough for tests: a textured plane seen by three cameras at two instants, with its exact prior."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from d2_plugin.adapters.deform import DeformAdapter
from d2_plugin.adapters.yang4d import Yang4DAdapter
from d2_plugin.backbones.deform import Deform
from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.backbones.yang4d import Yang4D
from d2_plugin.config import D2Config, DensifyConfig, DepthLossConfig, PruneConfig
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Label, View

WIDTH, HEIGHT, DISTANCE = 32, 24, 3.0
BACKBONES = ("yang4d", "deform")
"""The bundled backbones."""


def make_views() -> list[View]:
    """Three cameras side by side, looking along z at a plane z = 3; two frames."""
    intrinsics = torch.tensor([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])
    views = []
    for frame in range(2):
        for i, x in enumerate((-0.4, 0.0, 0.4)):
            pose = torch.eye(4)
            pose[0, 3] = -x
            views.append(View(f"cam{i}", frame, frame / 2, pose, intrinsics, WIDTH, HEIGHT))
    return views


class TinyFrames:
    def __init__(self) -> None:
        self.views = make_views()

    def image(self, index: int) -> Tensor:
        """A smooth texture fixed to the plane, [H, W, 3]."""
        view = self.views[index]
        rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
        x = (columns - view.K[0, 2]) / view.K[0, 0] * DISTANCE - view.T_camera_world[0, 3]
        y = (rows - view.K[1, 2]) / view.K[1, 1] * DISTANCE
        return torch.stack([torch.sin(3 * x), torch.cos(4 * y), torch.sin(2 * x + y)], -1) * 0.4 + 0.5


class TinyStore:
    """The exact depth as a prior: left half verified, right half mono-only, one column in conflict."""

    def prior(self, camera: str, frame: int) -> DepthPrior:
        labels = torch.full((HEIGHT, WIDTH), int(Label.MONO), dtype=torch.uint8)
        labels[:, : WIDTH // 2] = Label.VERIFIED
        labels[:, WIDTH // 2] = Label.CONFLICT
        depth = torch.where(labels == Label.CONFLICT, 0.0, DISTANCE)
        return DepthPrior(depth, labels, torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8))


class ChangedStore(TinyStore):
    """The tiny prior with something about it changed."""

    def __init__(self, change: Callable[[DepthPrior], object]) -> None:
        self.change = change

    def prior(self, camera: str, frame: int) -> object:
        return self.change(super().prior(camera, frame))


def make_model(
    count: int = 60, temporal: bool = True, seed: int = 0, backbone: str = "yang4d", **chosen: object
) -> SplatModel:
    """Gaussians scattered between the cameras and beyond the plane; `backbone` is one of `BACKBONES`."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(count, 3, generator=generator) * torch.tensor([3.0, 2.0, 3.0]) + torch.tensor(
        [-1.5, -1, 1.5]
    )
    colors, times = torch.rand(count, 3, generator=generator), torch.rand(count, generator=generator) / 2
    settings = {"densify": {"start": 0.1, "stop": 0.9, "every": 7, "gradient": 5e-3, "budget": 150}} | chosen
    kind: type[SplatModel] = Yang4D
    if backbone == "deform":
        kind, settings = Deform, settings | {"hexplane": {"features": 4, "resolutions": [4, 8]}}
    extents = {"extent": 2.0, "duration": 0.5}
    model = kind.create(positions, colors, times, **extents, temporal=temporal, settings=settings)
    with torch.no_grad():
        model.gaussians["opacity_logits"].zero_()  # opacity one half: enough to supervise depth from the first step
    return model


def bend_field(model: SplatModel, strength: float = 0.02) -> SplatModel:
    """The model, whose deformation field, where it has one, now moves its Gaussians."""
    if getattr(model, "field", None) is not None:
        with torch.no_grad():
            for parameter in model.field.heads.parameters():
                parameter.uniform_(-strength, strength, generator=torch.Generator().manual_seed(1))
    return model


def make_adapter(model: SplatModel) -> Yang4DAdapter | DeformAdapter:
    return Yang4DAdapter(model) if isinstance(model, Yang4D) else DeformAdapter(model)


ALL_HOOKS = D2Config(
    densify=DensifyConfig(start=5, stop=25, every=5, budget_per_view=20),
    prune=PruneConfig(start=5, stop=30, every=4, patience=2, tau_p=0.6),
    depth_loss=DepthLossConfig(every=1, weight=0.2),
    views_per_evaluation=3,
)


def make_trainer(
    config: D2Config | None = None, iterations: int = 30, kind: type[Trainer] = Trainer, **model: object
) -> Trainer:
    """A trainer of the tiny scene, with D2 attached where a configuration is given."""

    def attach(model: SplatModel) -> D2Hooks:
        return D2Hooks(config, make_adapter(model), TinyStore())

    settings = TrainSettings(iterations=iterations, seed=3)
    return kind(make_model(**model), TinyFrames(), settings, attach if config is not None else None)


def parameters(trainer: Trainer) -> dict[str, Tensor]:
    """All that is trained: Gaussians, and what the model has of a field, a background and gains of cameras."""
    return {name: value.detach().clone() for name, value in make_adapter(trainer.model).trained().items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)

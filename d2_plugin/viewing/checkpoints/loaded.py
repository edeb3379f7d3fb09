"""A trainer's Gaussians behind its adapter, without the trainer."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

from torch import Tensor

from d2_plugin import registry
from d2_plugin.captures import Capture
from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings


class Loaded(NamedTuple):
    """What a file holds, ready to be looked at."""

    backbone: Any
    """An adapter around the Gaussians."""
    time_scale: float
    """The trainer's unit of time, per second."""
    note: str = ""
    """What a person should know, in one sentence."""


def frozen(values: dict[str, Any]) -> SimpleNamespace:
    """The attributes of a trainer's model, without the trainer: it cannot grow or shrink."""

    def refuse(*_: Any, **__: Any) -> None:
        raise D2Error("a checkpoint that is looked at cannot be edited: train it in its own codebase")

    tensors = {name: value.detach() if isinstance(value, Tensor) else value for name, value in values.items()}
    return SimpleNamespace(**tensors, densification_postfix=refuse, prune_points=refuse)


def with_adapter(name: str, *arguments: Any, **options: Any) -> Any:
    """The adapter of that name around what it takes."""
    adapter: Any = registry.load(registry.ADAPTERS, name)
    return adapter(*arguments, **options)


def gsplat_model(parameters: dict[str, Tensor], settings: RasterSettings) -> Any:
    """Gaussians that stand still, by gsplat's names."""
    return with_adapter("gsplat", {name: value.detach() for name, value in parameters.items()}, {}, settings=settings)


def planes_model(values: dict[str, Any], field: Any, stage: str, capture: Capture) -> Loaded:
    """Gaussians of 4DGaussians with their field; in the coarse stage there is none."""
    count = max(len(capture.frames), 1)
    backbone = with_adapter("hust4d", frozen(values | {"_deformation": field}), None, stage)
    if stage == "coarse":
        return Loaded(backbone, 1.0, "the coarse stage of 4DGaussians stands still")
    return Loaded(
        backbone,
        capture.fps / count,
        "a frame's time is taken to be its number / the number of frames, as the trainer reads several cameras",
    )

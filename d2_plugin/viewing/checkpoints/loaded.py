"""A trainer's Gaussians behind its adapter, without the trainer."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians, moving_gaussians
from d2_plugin.gaussians.spherical_harmonics import channel_count
from d2_plugin.protocol import RasterSettings
from d2_plugin.recordings import Recording


class Loaded(NamedTuple):
    """What a file holds, ready to be looked at."""

    backbone: Any
    """An adapter around the Gaussians."""
    time_scale: float
    """The trainer's unit of time, per second."""
    note: str = ""
    """What a person should know, in one sentence."""
    harmonics: Harmonics | None = None
    """Colours; None where only the adapter can tell them, for one direction after the other."""
    moving: MovingGaussians | None = None
    """The same Gaussians as straight lines that fade, in seconds since the first frame, where they are of that form."""


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


def gsplat_model(parameters: Mapping[str, Tensor], settings: RasterSettings, note: str) -> Loaded:
    """Gaussians that stand still, by gsplat's names."""
    found = {name: value.detach() for name, value in parameters.items()}
    backbone = with_adapter("gsplat", dict(found), {}, settings=settings)
    if "sh0" not in found:
        return Loaded(backbone, 1.0, note)
    coefficients = torch.cat([found["sh0"], found["shN"]], 1) if "shN" in found else found["sh0"]
    harmonics = Harmonics(coefficients, round(coefficients.shape[1] ** 0.5) - 1)
    raw = {"positions": found["means"], "log_scales": found["scales"], "left": found["quats"]}
    moving = moving_gaussians(raw | {"opacity_logits": found["opacities"]}, harmonics)
    return Loaded(backbone, 1.0, note, moving.harmonics, moving)


def planes_model(values: dict[str, Any], field: Any, stage: str, recording: Recording) -> Loaded:
    """Gaussians of 4DGaussians with their field; in the coarse stage there is none."""
    count = max(len(recording.frames), 1)
    backbone = with_adapter("hust4d", frozen(values | {"_deformation": field}), None, stage)
    if stage == "coarse":
        return Loaded(backbone, 1.0, "the coarse stage of 4DGaussians stands still", harmonics_of(values))
    note = "a frame's time is taken to be its number / the number of frames, as the trainer reads several cameras"
    return Loaded(backbone, recording.fps / count, note, harmonics_of(values))


def harmonics_of(values: Mapping[str, Any], time_degree: int = 0) -> Harmonics:
    """The colours of a model of Inria's heirs, up to the degree that it uses so far."""
    degree = int(values["active_sh_degree"])
    coefficients = torch.cat([values["_features_dc"], values["_features_rest"]], 1).detach()
    used = coefficients[:, : channel_count(degree, time_degree)]
    return Harmonics(used.double().cpu(), degree, time_degree)

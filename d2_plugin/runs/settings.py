"""What a run is: its settings, checked, and what follows from them before anything is computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from d2_plugin import registry
from d2_plugin.config import D2Config, for_iterations
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.priors.settings import PriorSettings

HOOK_NAMES = ("prior", "densify", "prune", "depth_loss")
TABLES = ("backbone", "d2", "densify", "prune", "depth_loss", "priors", "plan")
"""What a configuration file may hold."""
OVERRIDABLE = ("temporal", "stereo")
"""Decisions of the plan that `[plan]` may take; the others follow from them and from the depth sources."""


@dataclass(frozen=True)
class RunSettings:
    """What is trained, on what, for how long. Two runs with equal settings are the same run."""

    capture: str
    train_cameras: tuple[str, ...]
    backbone: str = "yang4d"
    iterations: int = 3000
    hooks: tuple[str, ...] = HOOK_NAMES
    seed: int = 0
    downscale: int = 1
    frames: tuple[int, ...] | None = None
    test_cameras: tuple[str, ...] | None = None
    mono_onnx: str | None = None
    mono_kind: str | None = None
    priors: str | None = None
    device: str = "cpu"
    """Where the trainer runs: cpu or cuda."""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Tables over the defaults, see `TABLES`."""


def check(settings: RunSettings) -> RunSettings:
    """The same settings with absolute paths, or a D2Error for what cannot be."""
    if not settings.train_cameras:
        raise D2Error("no training camera: name at least one with --train-cameras")
    if settings.iterations < 1:
        raise D2Error(f"--iterations is {settings.iterations}: give at least 1")
    for name in settings.hooks:
        if name not in HOOK_NAMES:
            raise unknown_name("hook", name, [*HOOK_NAMES, "all", "none"])
    if settings.mono_onnx and settings.mono_kind not in ("relative", "metric"):
        raise D2Error("--mono-onnx needs --mono-kind relative (inverse depth) or metric (depth): a file does not tell")
    _check_device(settings.device)
    for name in settings.overrides:
        if name not in TABLES:
            raise unknown_name("table", name, TABLES)
    for name in settings.overrides.get("plan", {}):
        if name not in OVERRIDABLE:
            raise unknown_name("decision of plan", name, OVERRIDABLE)
    prior_settings(settings)
    hook_config(settings, Path())
    backbone = registry.load(registry.BACKBONES, settings.backbone)
    backbone.settings_from(settings.overrides.get("backbone", {}))
    paths = ("capture", "mono_onnx", "priors")
    absolute = {name: str(Path(path).resolve()) for name in paths if (path := getattr(settings, name)) is not None}
    return replace(settings, **absolute)  # a run is found again from any folder


def _check_device(name: str) -> None:
    if name not in ("cpu", "cuda"):
        raise unknown_name("device", name, ("cpu", "cuda"))
    if name == "cuda" and not torch.cuda.is_available():
        raise D2Error("--device cuda, but torch finds no CUDA device here: leave out --device to train on the CPU")


def prior_settings(settings: RunSettings) -> PriorSettings:
    """Settings of the prior builder: defaults, the monocular source of the run, the user's table over them."""
    source = {"mono_onnx": settings.mono_onnx, "mono_kind": settings.mono_kind}
    return PriorSettings.from_dict(source | settings.overrides.get("priors", {}))


def hook_config(settings: RunSettings, priors: Path) -> D2Config:
    """The hooks of a run with schedules that fit its length, and the user's tables over the defaults."""
    hooks = tuple(name for name in settings.hooks if name != "prior")
    config = for_iterations(hooks, settings.iterations, prior=str(priors), seed=settings.seed)
    tables = {name: settings.overrides.get(name, {}) for name in hooks}
    return D2Config.from_dict(
        {name: value for name, value in vars(config).items() if name not in hooks}
        | dict(settings.overrides.get("d2", {}))
        | {name: vars(getattr(config, name)) | tables[name] for name in hooks}
    )

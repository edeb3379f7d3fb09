"""The settings of a run, their checks, and what follows from them before anything is computed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from d2_plugin import registry
from d2_plugin.config import D2Config, for_iterations
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.hooks import HOOKS
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.reading import parsing, shown_path
from d2_plugin.settings import (
    FORMAT,
    Count,
    Downscale,
    Positional,
    Range,
    Seed,
    Settings,
    Share,
    declared,
    of_this_format,
)
from d2_plugin.values import shown

HOOK_NAMES = ("prior", *HOOKS)
"""What `--hooks` may name; "prior" alone builds the depth prior and trains without it."""
WORTH_FROM = {"motion": 200, "parallax": 500}
"""Steps from which hooks that look between what was recorded are worth their time; a shorter run makes more steps."""
TABLES = ("backbone", "training", "d2", *HOOKS, "priors", "plan")
"""What a configuration file may hold."""
PATHS = ("recording", "mono_onnx", "multiview", "priors")
"""The settings of a run that are paths."""


@dataclass(frozen=True)
class PlanChoices(Settings):
    """Decisions of the plan that `[plan]` may take; the others follow from them and from the depth sources."""

    temporal: bool | None = None
    """Whether the scene has a temporal dimension; if not given, the plan measures it."""
    stereo: bool | None = None
    """Whether the cameras are matched; if not given, the plan measures it."""
    appearance: bool | None = None
    """Whether each training camera learns a change of colour; if not given, triangulated points decide."""


OVERRIDABLE = tuple(choice.name for choice in declared(PlanChoices))


@dataclass(frozen=True)
class RunSettings(Settings):
    """What is trained, on what, for how long. Two runs with equal settings are the same run."""

    recording: Annotated[str, Positional()]
    """Folder of the recording."""
    train_cameras: tuple[str, ...]
    """Cameras to train with, as the recording names them."""
    backbone: str = "yang4d"
    """Name of a registered backbone."""
    iterations: Annotated[int, Range(1, unit="steps")] = 3000
    """Steps to train."""
    hooks: tuple[str, ...] = HOOK_NAMES
    """Parts of the method that are used."""
    seed: Seed = 0
    """Seed of everything that is drawn at random."""
    downscale: Downscale = 1
    """Make images this many times smaller along each side."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames to use; all if not given."""
    hold_out_instants: Annotated[int, Range(0, 10_000, unit="instants")] = 0
    """Train every so-manieth instant alone and score those between apart (`psnr_between`); 0 or 1 trains all."""
    test_cameras: tuple[str, ...] | None = None
    """Cameras to score with; all that do not train if not given."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns: relative (inverse depth up to scale and shift) or metric (depth)."""
    multiview: str | None = None
    """Depth of all views from one network: a folder with FRAME.npz, or an ONNX file."""
    priors: str | None = None
    """Folder of a finished depth prior; without it the run builds its own."""
    accept_empty_prior: bool = False
    """Train even where no view has a usable prior."""
    background_weight: Share = 1.0
    """Photometric weight of pixels outside the recording's foreground masks; 1 looks at no mask, 0 learns the
    foreground alone."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the trainer runs."""
    protocol: str | None = None
    """Name of the preset or protocol that chose the cameras; cameras that are named have none."""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Tables over the defaults, see `TABLES`."""

    @classmethod
    def from_table(cls, table: Mapping[str, Any], place: str) -> RunSettings:
        """From what `as_table` made, or a version of it that this one reads; `place` names the file in errors."""
        return cls.from_dict(of_this_format(table, place), place)

    def as_table(self) -> dict[str, Any]:
        """Plain values and the version of the format, as JSON has them."""
        return {"version": FORMAT} | json.loads(json.dumps(asdict(self)))


def check(settings: RunSettings) -> RunSettings:
    """The same settings with absolute paths, or a D2Error for what cannot be."""
    import torch

    if not settings.train_cameras:
        raise D2Error("no training camera: name at least one with --train-cameras")
    refuse_unknown("hook", settings.hooks, HOOK_NAMES)
    if settings.mono_onnx and settings.mono_kind is None:
        raise D2Error("--mono-onnx needs --mono-kind relative (inverse depth) or metric (depth): the file names none")
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise D2Error("--device cuda, but torch finds no CUDA device here: leave out --device to train on the CPU")
    _check_overrides(settings)
    absolute = {name: _absolute(path, name) for name in PATHS if (path := getattr(settings, name)) is not None}
    return replace(settings, **absolute)  # type: ignore[arg-type]  # a run is found again from any folder


def _absolute(path: str, name: str) -> str:
    if not path:
        raise D2Error(f"{name} is no text at all, expected a path: name it, or a dot for the current folder")
    with parsing(f"{name} {shown_path(path)[:200]}", "correct it"):  # a zero byte, a name too long, links in a circle
        return str(Path(path).resolve())


def _check_overrides(settings: RunSettings) -> None:
    if {"version", "prior"} <= settings.overrides.keys():
        raise D2Error(
            "the configuration is a d2.toml, which D2Hooks.from_config takes: for a run, put what stands above its "
            "first table under [d2], and leave out version and prior"
        )
    refuse_unknown("table", settings.overrides, TABLES)
    choices = _over({}, settings.overrides.get("plan", {}), "plan")
    refuse_unknown("decision of plan", choices, OVERRIDABLE)
    PlanChoices.from_dict(choices, "plan")
    prior_settings(settings)
    hook_config(settings, Path())
    for name in set(HOOKS) & set(settings.overrides):  # those of hooks that are off as well
        HOOKS[name].config.from_dict(settings.overrides[name], name)
    backbone = registry.load(registry.BACKBONES, settings.backbone)
    backbone.settings_from(_over({}, settings.overrides.get("backbone", {}), "backbone"))
    training_settings(settings, backbone)


def training_settings(settings: RunSettings, backbone: Any) -> Any:
    """Length and seed of the run beside what the user's table says of the loss, as the backbone has them."""
    own = {"iterations": settings.iterations, "seed": settings.seed}
    table = _over({}, settings.overrides.get("training", {}), "training")
    for name in table:
        if name in own:
            raise D2Error(f"training.{name} is a setting of the run: give it as --{name}")
    return backbone.TrainSettings.from_dict({**table, **own}, "training")


def prior_settings(settings: RunSettings) -> PriorSettings:
    """Settings of the prior builder: defaults, the monocular source of the run, the user's table over them."""
    source = {name: getattr(settings, name) for name in ("mono_onnx", "mono_kind", "multiview")}
    return PriorSettings.from_dict(_over(source, settings.overrides.get("priors", {}), "priors"), "priors")


def hooks_in_use(settings: RunSettings) -> tuple[str, ...]:
    """Names of the run's hooks: of `WORTH_FROM`, those that are worth it here or have a table."""
    early = {name for name, steps in WORTH_FROM.items() if settings.iterations < steps} - {*settings.overrides}
    return tuple(name for name in settings.hooks if name not in {"prior", *early})


def hook_config(settings: RunSettings, priors: Path, trials: Mapping[str, Any] | None = None) -> D2Config:
    """The hooks of a run with schedules that fit its length, what trials showed, and the user's tables over these."""
    hooks = hooks_in_use(settings)
    d2 = settings.overrides.get("d2", {})
    for name in d2 if isinstance(d2, Mapping) else ():
        if name in HOOKS:
            raise D2Error(f"d2.{name} is a table of its own: write its settings under [{name}]")
    believe = None if trials is None else trials["choice"]
    config = for_iterations(hooks, settings.iterations, prior=str(priors), seed=settings.seed, believe=believe)
    plain = {name: value for name, value in asdict(config).items() if name not in HOOKS}
    tables = {name: _over(asdict(getattr(config, name)), settings.overrides.get(name, {}), name) for name in hooks}
    return D2Config.from_dict(_over(plain, d2, "d2") | tables)


def layered(below: Any, above: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables with others over them; neither is changed."""
    result = dict(below) if isinstance(below, Mapping) else {}
    for key, value in above.items():
        result[key] = layered(result.get(key), value) if isinstance(value, Mapping) else value
    return result


def _over(defaults: Mapping[str, Any], table: Any, name: str) -> dict[str, Any]:
    """The defaults with the user's table over them."""
    if not isinstance(table, Mapping):
        raise D2Error(f"{name} must be a table of settings, got {shown(table)}: write [{name}] above them")
    return {**defaults, **table}

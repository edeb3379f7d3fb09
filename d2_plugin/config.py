"""One dataclass per hook; a hook is switched on by its presence. TOML in and out.

The paper's supplement, which fixes thresholds, weights and schedules, is not public: the defaults here are this
project's own choices, set by measurement. "Studio" in a docstring means the rendered studio capture (320x180, four
training views 00 02 05 07, frames 0 to 8, emulated monocular depth, one seed), the number held-out PSNR.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error, unknown_name


@dataclass(frozen=True)
class DensifyConfig:
    """Depth-guided insertion."""

    start: int = 1
    """First step at which it may run."""
    stop: int | None = 1500
    """First step at which it no longer runs; refinement continues after it."""
    every: int = 100
    """Steps between evaluations."""
    tau_v: float = 0.5
    """A rendered depth is valid where the accumulated alpha exceeds this."""
    tau_u: float = 0.1
    """Relative depth error above which a verified pixel counts as under-reconstructed."""
    tau_u_mono: float = 0.2
    """The same for a mono-only pixel, whose depth is itself off by some per cent."""
    budget_per_view: int = 60
    """Samples drawn per evaluated view. Studio, all 20 frames, 2000 steps, three seeds: 28.9 dB at 60, training 1.13 to
    1.17 times as long as the bare trainer; 30.3 dB at 500 with 8 views per evaluation and the loss at every step, 1.4
    times as long as that. 1500 loses again (28.2 against 29.3 dB at 500, 1210 steps)."""
    max_gaussians: int = 1_000_000
    """No insertion beyond this number of Gaussians."""
    scale: float = 1.0
    """Standard deviation of a new Gaussian in units of the distance between samples (studio: 29.3 dB at 0.5, 30.7 at
    1.0, 30.2 at 1.5)."""
    opacity: float = 0.3
    """Opacity of a new Gaussian (studio: 29.3 dB at 0.3, 29.5 at 0.1)."""
    cell: float = 1.0
    """Side of the frustum cells that keep duplicates out, in units of the distance between samples."""
    occupied_opacity: float = 0.1
    """An existing Gaussian with at least this opacity occupies its cell."""


@dataclass(frozen=True)
class PruneConfig:
    """Consistency-aware removal."""

    start: int = 300
    """First step at which it may run."""
    stop: int | None = 2000
    """First step at which it no longer runs."""
    every: int = 100
    """Steps between evaluations."""
    tau_u: float = 0.1
    """Relative depth error at which E_k saturates."""
    tau_p: float = 0.75
    """Score above which an evaluation counts against a Gaussian."""
    lambda_e: float = 0.5
    """Weight of depth inconsistency; lambda_e + lambda_o = 1."""
    lambda_o: float = 0.5
    """Weight of missing opacity contribution."""
    patience: int = 3
    """Evaluations in a row, each touching verified pixels, before a Gaussian is removed."""

    def __post_init__(self) -> None:
        if self.lambda_e < 0 or self.lambda_o < 0 or abs(self.lambda_e + self.lambda_o - 1) > 1e-9:
            raise D2Error(
                f"lambda_e = {self.lambda_e} and lambda_o = {self.lambda_o} must not be negative and must sum to 1"
            )


@dataclass(frozen=True)
class DepthLossConfig:
    """Verified-depth supervision."""

    start: int = 1
    """First step at which it is added."""
    stop: int | None = None
    """First step at which it is no longer added; None: to the end."""
    every: int = 4
    """Steps between additions: a depth changes slowly, and the loss costs time at each step that has it."""
    weight: float = 0.8
    """lambda_d of each addition; what matters is weight / every (studio, 2000 steps, 4 views per evaluation: 28.5 dB at
    0.4 / 2, 28.6 at 0.8 / 4; earlier, 1210 steps: 29.3 dB and depth AbsRel .086 at 0.2 / 1, 29.1 dB and .073 at 1 / 1,
    0.4 dB less without)."""
    epsilon: float = 0.01
    """epsilon_rho of the Charbonnier penalty, on relative depth residuals."""
    tau_v: float = 0.5
    """Pixels whose accumulated alpha does not exceed this are left out."""


@dataclass(frozen=True)
class D2Config:
    """The prior to use and the hooks to build; a hook that is None is never built."""

    prior: str | None = None
    """Folder of the depth prior, as `d2 priors` writes it."""
    densify: DensifyConfig | None = None
    prune: PruneConfig | None = None
    depth_loss: DepthLossConfig | None = None
    views_per_evaluation: int = 4
    """Training views surveyed at each structure update, taken in turn over all cameras and frames."""
    retire_after: int = 5
    """Evaluations in a row that change next to nothing after which a structure hook retires; 0: never."""
    retire_below: float = 1e-3
    """Share of the Gaussians; an evaluation that changes fewer has changed next to nothing."""
    seed: int = 0
    """Of D2's own random generator."""

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> D2Config:
        """From nested mappings, as in TOML; unknown names and wrong types are refused with one sentence."""
        known = {f.name for f in fields(cls)}
        for name in table:
            if name not in known:
                raise unknown_name("hook" if isinstance(table[name], Mapping) else "setting", name, known)
        values = {name: _section(name, value) for name, value in table.items()}
        return cls(**values)

    @classmethod
    def from_toml(cls, path: str | Path) -> D2Config:
        """From a TOML file: `prior = "..."` and one table per hook, empty for its defaults."""
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text())
        except FileNotFoundError:
            raise D2Error(f"no configuration at {path}: write one, or pass the settings as a dict") from None
        except tomllib.TOMLDecodeError as error:
            raise D2Error(f"{path} is not valid TOML: {error}") from None
        config = cls.from_dict(table)
        if config.prior is not None and not Path(config.prior).is_absolute():
            config = replace(config, prior=str(path.parent / config.prior))
        return config

    def to_toml(self) -> str:
        """The same configuration as text, complete with defaults."""
        table = {name: value for name, value in asdict(self).items() if value is not None}
        plain = {name: value for name, value in table.items() if not isinstance(value, dict)}
        lines = [f"{name} = {_literal(value)}" for name, value in plain.items()]
        for name, section in table.items():
            if isinstance(section, dict):
                lines += ["", f"[{name}]"]
                lines += [f"{key} = {_literal(value)}" for key, value in section.items() if value is not None]
        return "\n".join(lines) + "\n"

    @property
    def hooks(self) -> tuple[str, ...]:
        """Names of the hooks that will be built."""
        return tuple(name for name in HOOKS if getattr(self, name) is not None)


HOOKS: dict[str, type] = {"densify": DensifyConfig, "prune": PruneConfig, "depth_loss": DepthLossConfig}
"""Hooks in the order in which they run, with their configurations."""


def for_iterations(hooks: tuple[str, ...], iterations: int, **settings: Any) -> D2Config:
    """The named hooks with schedules that fit a run of `iterations` steps; `settings` are further fields of D2Config.

    Insertion from the first tenth to half of the run, pruning from a fifth to two thirds, depth loss throughout:
    the last third only refines.
    """
    for name in hooks:
        if name not in HOOKS:
            raise unknown_name("hook", name, ["prior", *HOOKS])
    every = max(1, min(100, iterations // 20))
    schedules = {
        "densify": DensifyConfig(start=every, stop=max(iterations // 2, every + 1), every=every),
        "prune": PruneConfig(start=iterations // 5, stop=2 * iterations // 3, every=every),
        "depth_loss": DepthLossConfig(),
    }
    return D2Config(**{name: schedules[name] for name in hooks}, **settings)


def _section(name: str, value: Any) -> Any:
    """One entry of the table as the dataclass or plain value it stands for, checked."""
    if name not in HOOKS or value is None or isinstance(value, HOOKS[name]):
        return value
    if not isinstance(value, Mapping):
        raise D2Error(f"hook '{name}' must be a table of settings, got {value!r}: write [{name}] above its settings")
    known = {f.name: f for f in fields(HOOKS[name])}
    for key, setting in value.items():
        if key not in known:
            raise unknown_name(f"setting of {name}", key, known)
        if setting is not None and (isinstance(setting, bool) or not isinstance(setting, (int, float))):
            raise D2Error(f"{name}.{key} must be a number, got {setting!r}")
    return HOOKS[name](**value)


def _literal(value: Any) -> str:
    """A TOML literal."""
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return str(value).lower() if isinstance(value, bool) else repr(value)

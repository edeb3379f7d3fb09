"""The configuration of D2: its prior, and one table per hook. A hook is switched on by its presence. TOML in and out.

The paper's supplement, which fixes thresholds, weights and schedules, is not public: the defaults are this project's
own choices, set by measurement.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional, cast

from d2_plugin.errors import refuse_unknown, unknown_name
from d2_plugin.hooks import HOOKS, DensifyConfig, DepthLossConfig, MotionConfig, ParallaxConfig, PruneConfig
from d2_plugin.hooks.prior import Belief
from d2_plugin.reading import read_toml
from d2_plugin.settings import FORMAT, NONE, AtLeastOne, Count, Range, Seed, Settings, of_this_format
from d2_plugin.values import checked_arguments

__all__ = [
    "D2Config",
    "DensifyConfig",
    "DepthLossConfig",
    "MotionConfig",
    "ParallaxConfig",
    "PruneConfig",
    "for_iterations",
]

if TYPE_CHECKING:
    _HookTables: Any = Settings
else:  # one field per row of the table of hooks
    _HookTables = make_dataclass(
        "_HookTables",
        [(name, Optional[row.config], None) for name, row in HOOKS.items()],  # noqa: UP045  at run time, on Python 3.9 too
        bases=(Settings,),
        frozen=True,
        namespace={"__module__": __name__},
    )


@dataclass(frozen=True)
class D2Config(_HookTables):
    """The prior and the hooks, one table each; without one a hook is not built."""

    prior: str | None = None
    """Folder of the depth prior, as `d2 priors` writes it."""
    believe: Belief | None = None
    """What of the prior is used: all of it, stereo alone, or nothing. None: what trials with a left-out training camera
    showed of this prior, which `d2 priors` and `d2 train` make; all of it where there were none."""
    exported: str | None = None
    """Folder that `d2 export-recording` wrote and the trainer reads, where the prior is that of the source: its cameras
    and frames have other names there. Found without this where the trainer's cameras know the paths of their images.
    """
    iterations: AtLeastOne | None = None
    """Steps of the trainer's run: what the hooks' tables leave out of start, stop, every and budget follows from it."""
    views_per_evaluation: Annotated[int, Range(1, 10_000)] = 8
    """Training views surveyed at each structure update, taken in turn over all cameras and frames; at the first one at
    least one of each camera seen so far, and more, up to 64, where not all would have been when insertion ends."""
    retire_after: Count = 5
    """A structure hook retires after this many evaluations in a row that change next to nothing (less than a thousandth
    of the Gaussians); 0: never."""
    remove_at_most: Annotated[float, Range(1e-6, 1)] = 0.9
    """Largest share of the Gaussians that all hooks together remove in one step; what is more waits for the next
    evaluation, where it must be asked for again. 1 sets no limit, as the paper."""
    finite_every: Count = 100
    """Steps from one check to the next that all parameters are finite; they are checked before hooks edit Gaussians and
    before their state is saved as well. Training stops where one is not; 0 never checks."""
    prior_memory_mb: Annotated[int, Range(1, 1_000_000, unit="MB")] = 2048
    """Memory of the host, not of the GPU, for priors that were read: 8 bytes a pixel and view. The least recently used
    leave first and are read again; the log says when that begins."""
    seed: Seed = 0
    """Seed of D2's own random generator."""

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "", pace: Callable[[int], int] = int) -> D2Config:
        """From nested mappings, as in TOML; an unknown name, a wrong type or value is refused with one sentence.

        `pace` gives the step of schedules from that of the trainer (`d2_plugin.protocol.schedule_step`).
        """
        plain = of_this_format(table, where or "the configuration")
        for name, value in plain.items():
            if isinstance(value, Mapping) and name not in HOOKS:
                raise unknown_name("hook", name, HOOKS)
        length = plain.get("iterations")
        if isinstance(length, int) and not isinstance(length, bool) and length > 0:
            paced = max(1, pace(length))
            plain |= {name: _scheduled(name, plain[name], paced) for name in HOOKS if name in plain}
        return super().from_dict(plain, where)

    @classmethod
    @checked_arguments
    def from_toml(cls, path: str | Path, iterations: int | None = None, pace: Callable[[int], int] = int) -> D2Config:
        """From a TOML file: `prior = "..."` and one table per hook, empty for its defaults.

        `iterations` is the length of the run where the file does not say one; `pace` as in `from_dict`.
        """
        path = Path(path)
        table = read_toml(path, "correct the configuration, or pass the settings as a dict")
        length = {} if iterations is None else {"iterations": iterations}
        config = cls.from_dict(length | of_this_format(table, str(path)), pace=pace)
        below = {name: str(path.parent / value) for name in ("prior", "exported") if (value := getattr(config, name))}
        return replace(config, **cast("dict[str, Any]", below))

    def to_toml(self) -> str:
        """The same configuration as text, complete with defaults and the version of the format."""
        table = {"version": FORMAT} | {name: value for name, value in asdict(self).items() if value is not None}
        plain = {name: value for name, value in table.items() if not isinstance(value, dict)}
        lines = [f"{name} = {_literal(value)}" for name, value in plain.items()]
        for name, section in table.items():
            if isinstance(section, dict):
                lines += ["", f"[{name}]"]
                lines += [f"{key} = {_literal(value)}" for key, value in section.items()]
        return "\n".join(lines) + "\n"

    @property
    def hooks(self) -> tuple[str, ...]:
        """Names of the hooks that will be built."""
        return tuple(name for name in HOOKS if getattr(self, name) is not None)


@checked_arguments
def for_iterations(hooks: Iterable[str], iterations: int, **settings: Any) -> D2Config:
    """The named hooks with schedules that fit a run of `iterations` steps; `settings` are further fields of D2Config.

    The schedule of a hook is that of its settings, see `HookConfig.for_iterations`.
    """
    names = list(hooks)
    refuse_unknown("hook", names, HOOKS)
    chosen: dict[str, Any] = {name: HOOKS[name].config.for_iterations(iterations) for name in names}
    return D2Config(**chosen, **settings)


def _scheduled(name: str, table: Any, iterations: int) -> Any:
    """A hook's table with what it leaves out of its schedule, for a run of so many steps."""
    if not isinstance(table, Mapping):
        return table
    fitting, usual = (asdict(made) for made in (HOOKS[name].config.for_iterations(iterations), HOOKS[name].config()))
    return {key: value for key, value in fitting.items() if value != usual[key]} | dict(table)


def _literal(value: Any) -> str:
    """A TOML literal."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_literal, value)) + "]"
    if value is None:
        return f'"{NONE}"'
    return str(value).lower() if isinstance(value, bool) else repr(value)

"""Every row of the paper's two ablation tables as a preset: which hooks run, and what is set differently."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from d2_plugin.errors import unknown_name
from d2_plugin.runs.scene import Guidance
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, layered
from d2_plugin.runs.shared import Shared


@dataclass(frozen=True)
class Preset:
    """One variant of the method."""

    name: str
    title: str
    """As the paper's table writes it, where it is a row of one."""
    hooks: tuple[str, ...] = HOOK_NAMES
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Tables over the defaults, as in a configuration file."""
    guidance: Callable[[int], Guidance] | None = None
    """Makes what guides a run of so many steps in place of D2's hooks."""
    prior_seconds: Callable[[RunSettings, float | None], float | None] = lambda settings, full: full
    """CPU seconds of what it needs of a prior that took so long; for presets with guidance."""

    def seconds_of_prior(self, settings: RunSettings, shared: Shared) -> float | None:
        """CPU seconds of what a run of this preset needs beforehand, of all that was shared."""
        if self.guidance is not None:
            return self.prior_seconds(settings, shared.seconds)
        return shared.seconds if self.hooks else 0.0

    def merged(self, tables: Mapping[str, Any]) -> dict[str, Any]:
        """The user's `tables` with this preset's settings over them; neither is changed."""
        return layered(tables, self.overrides)


def _without(hook: str) -> tuple[str, ...]:
    return tuple(name for name in HOOK_NAMES if name != hook)


PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("backbone", "Backbone", ()),
        Preset("mono_only", "Mono only", overrides={"priors": {"variant": "mono"}}),
        Preset("mvs_only", "MVS only", overrides={"priors": {"variant": "mvs"}}),
        Preset("dual_unaligned", "Dual w/o align.", overrides={"priors": {"variant": "dual_unaligned"}}),
        Preset("dual_unverified", "Dual w/o verify.", overrides={"priors": {"variant": "dual_unverified"}}),
        Preset("no_densification", "w/o Densification", _without("densify")),
        Preset("no_pruning", "w/o Pruning", _without("prune")),
        Preset("no_rgbd", "w/o RGB-D", _without("depth_loss")),
        Preset("no_motion", "w/o motion", _without("motion")),
        Preset("no_parallax", "w/o parallax", _without("parallax")),
        Preset("no_carrying_on", "nothing carried on", overrides={"densify": {"carry_on": False}}),
        Preset("motion_by_loss", "motion by the loss only", overrides={"motion": {"insert": False}}),
        Preset("motion_by_insertion", "motion at insertion only", overrides={"motion": {"weight": 0.0}}),
        Preset("full", "D²-4DGS"),
        Preset("opacity_only", "Opacity only", overrides={"prune": {"lambda_e": 0.0}}),
        Preset("depth_only", "Depth only", overrides={"prune": {"lambda_e": 1.0}}),
        Preset(
            "full_d2_densification_only",
            "D²-4DGS, own densification off",
            overrides={"backbone": {"densify": {"enabled": False}}},
        ),
    )
}
"""By name. In the prior variants densification, pruning and RGB-D optimization are those of `full`, as in the paper."""

TABLES: dict[str, tuple[str, ...]] = {
    "ablation": (
        *("backbone", "mono_only", "mvs_only", "dual_unaligned", "dual_unverified"),
        *("no_densification", "no_pruning", "no_rgbd", "full", "full_d2_densification_only"),
    ),
    "motion": ("no_motion", "motion_by_insertion", "motion_by_loss", "full"),
    "parallax": ("no_parallax", "full"),
    "carrying_on": ("no_carrying_on", "full"),
    "pruning": ("no_pruning", "opacity_only", "depth_only", "full"),
    "main": ("backbone", "full"),
}
"""The rows of each table: the paper's tab:ablation (and one row of ours), its tab:pruning_criteria, and the two
that its tab:main_results compares. A row that two tables share is run once."""

PUBLISHED: dict[str, tuple[str, dict[str, float]]] = {
    "ablation": (
        "tab:ablation: sear_steak of N3DV, 4 views",
        {
            **{"backbone": 25.3987, "mono_only": 25.9236, "mvs_only": 25.6174, "dual_unaligned": 25.8469},
            **{"dual_unverified": 26.1183, "no_densification": 26.0384, "no_pruning": 26.5217, "no_rgbd": 26.4472},
            "full": 27.2302,
        },
    ),
    "pruning": (
        "tab:pruning_criteria: actor5_6 of ENeRF-Outdoor, 4 views",
        {"no_pruning": 21.1874, "opacity_only": 21.5663, "depth_only": 21.9076, "full": 22.2082},
    ),
}
"""What each of the paper's tables is about, and its PSNR by preset, dB. Measured by its authors on their machine with
camera splits that are not public: for comparing the order of rows, not their size."""


def rows_named(
    names: Sequence[str], presets: Mapping[str, Preset] = PRESETS, tables: Mapping[str, Sequence[str]] = TABLES
) -> tuple[Preset, ...]:
    """The presets of tables and single presets, each once, in the order of `presets`.

    Raises:
        D2Error: neither a table nor a preset.
    """
    wanted: set[str] = set()
    for name in names or [""]:
        if name not in tables and name not in presets:
            raise unknown_name("table or preset", name, [*tables, *presets])
        wanted.update(tables.get(name, (name,)))
    return tuple(preset for name, preset in presets.items() if name in wanted)

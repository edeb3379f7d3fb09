"""The hooks; each file is the hook's settings, its equations as pure functions, and one thin class.

`HOOKS` lists them all: what configuration, plugin, runs, help and errors know of them comes from there.

Adding a hook touches one file and this list. The file holds its settings and its class,

    @dataclass(frozen=True)
    class ShrinkConfig(HookConfig):
        \"\"\"Keeps Gaussians small.\"\"\"

        weight: NotNegative = 0.01
        \"\"\"Of the mean variance.\"\"\"

    class Shrink(Hook):
        def loss(self, context: Context) -> Tensor:
            return self.config.weight * context.backbone.slice_at(context.views[0]).covariances.mean()

and the list one row: `"shrink": HookRow(ShrinkConfig, Shrink, edits_structure=False)`. From then on `[shrink]` in TOML
builds it, every setting of it is checked, `d2 train --hooks` knows its name, and its state is saved and resumed.
"""

from __future__ import annotations

from typing import NamedTuple

from d2_plugin.hooks.densify import Densify, DensifyConfig
from d2_plugin.hooks.depth_loss import DepthLoss, DepthLossConfig
from d2_plugin.hooks.hook import Context, Hook, HookConfig
from d2_plugin.hooks.motion import Motion, MotionConfig
from d2_plugin.hooks.parallax import Parallax, ParallaxConfig
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.hooks.prune import Prune, PruneConfig

__all__ = [
    "HOOKS",
    "Context",
    "DensifyConfig",
    "DepthLossConfig",
    "Hook",
    "HookConfig",
    "MotionConfig",
    "ParallaxConfig",
    "PriorLoader",
    "PruneConfig",
]


class HookRow(NamedTuple):
    """What there is to know of one hook."""

    config: type[HookConfig]
    hook: type[Hook]
    edits_structure: bool
    """Whether it inserts or removes Gaussians; its evaluations survey several views, and it retires when idle."""


HOOKS: dict[str, HookRow] = {
    "densify": HookRow(DensifyConfig, Densify, edits_structure=True),
    "prune": HookRow(PruneConfig, Prune, edits_structure=True),
    "depth_loss": HookRow(DepthLossConfig, DepthLoss, edits_structure=False),
    "motion": HookRow(MotionConfig, Motion, edits_structure=False),
    "parallax": HookRow(ParallaxConfig, Parallax, edits_structure=False),
}
"""Hooks by name, in the order in which they run."""

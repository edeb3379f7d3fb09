"""The hooks; each file is the hook's settings, its equations as pure functions, and one thin class.

`table` names them all.
"""

from __future__ import annotations

from d2_plugin.hooks.densify import Densify, DensifyConfig
from d2_plugin.hooks.depth_loss import DepthLoss, DepthLossConfig
from d2_plugin.hooks.hook import Context, Hook, HookConfig, Surveyed, Window
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.hooks.prune import Prune, PruneConfig

__all__ = [
    "Context",
    "Densify",
    "DensifyConfig",
    "DepthLoss",
    "DepthLossConfig",
    "Hook",
    "HookConfig",
    "PriorLoader",
    "Prune",
    "PruneConfig",
    "Surveyed",
    "Window",
]

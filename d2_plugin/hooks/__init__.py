"""The hooks; each file is the hook's settings, its equations as pure functions, and one thin class.

`table` names them all.
"""

from __future__ import annotations

from .densify import Densify, DensifyConfig
from .depth_loss import DepthLoss, DepthLossConfig
from .hook import Context, Hook, HookConfig, Surveyed, Window
from .prior import PriorLoader
from .prune import Prune, PruneConfig

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

"""The four hooks: prior, densify, prune, depth loss; each is pure functions (the equations) and a thin class."""

from __future__ import annotations

from .densify import Densify
from .depth_loss import DepthLoss
from .hook import Context, Hook, Surveyed, Window
from .prior import PriorLoader
from .prune import Prune

__all__ = ["Context", "Densify", "DepthLoss", "Hook", "PriorLoader", "Prune", "Surveyed", "Window"]

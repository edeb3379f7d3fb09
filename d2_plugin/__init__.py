"""D2-4DGS: dual-source depth guidance for any 4D Gaussian Splatting trainer.

Importing the package loads nothing heavy and compiles nothing; `D2Hooks` and `D2Config` are what a trainer needs.
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

_EXPORTS = {"D2Hooks": "d2_plugin.plugin", "D2Config": "d2_plugin.config", "D2Error": "d2_plugin.errors"}

__all__ = ["D2Config", "D2Error", "D2Hooks", "__version__"]


def __getattr__(name: str) -> object:
    """Load an exported name at first use (PEP 562)."""
    if name not in _EXPORTS:
        raise AttributeError(f"module 'd2_plugin' has no attribute '{name}': it exports {', '.join(_EXPORTS)}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)

"""`mmcv.Config.fromfile`: a configuration that is a Python file of plain values, with `_base_` files below it.

mmcv dropped this class in its version 2, and the version that has it builds on few machines; 4DGaussians needs nothing
else of it.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any


class Config(dict):
    """Nested values; `config["a"]` and `config.a` alike."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None

    @classmethod
    def fromfile(cls, filename: str | Path, **_: Any) -> Config:
        """The values of a file over those of its `_base_`, one file or a list, relative to it."""
        path = Path(filename)
        own = {name: value for name, value in runpy.run_path(str(path)).items() if not name.startswith("__")}
        bases = own.pop("_base_", [])
        merged: dict[str, Any] = {}
        for base in [bases] if isinstance(bases, str) else bases:
            merged = _over(merged, cls.fromfile(path.parent / base))
        plain = {name: value for name, value in own.items() if not callable(value)}
        return cls(_over(merged, plain))


def _over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for name, value in above.items():
        inner = merged.get(name)
        if isinstance(value, dict):
            value = Config(_over(inner if isinstance(inner, dict) else {}, value))
        merged[name] = value
    return merged

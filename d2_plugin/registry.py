"""Backbones and adapters by name, from entry points: a third party adds one with no edit here."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.reading import said

BACKBONES = "d2_plugin.backbones"
"""Entry-point group of modules with create, settings_from, Trainer and TrainSettings (see backbones/yang4d.py)."""

ADAPTERS = "d2_plugin.adapters"
"""Entry-point group of callables that take a model and return a `d2_plugin.protocol.Backbone`."""


def names(group: str) -> list[str]:
    """What is registered in a group, sorted."""
    return sorted(_points(group))


def load(group: str, name: str) -> Any:
    """The registered object of that name; an unknown name is refused, with the known ones."""
    points = _points(group)
    if not points:
        raise D2Error("this Python has no installed d2-4dgs: run `pip install -e .` in its checkout")
    refuse_unknown(group.rsplit(".", 1)[1].removesuffix("s"), [name], points)
    try:
        return points[name].load()
    except D2Error:
        raise
    except Exception as failure:  # whatever somebody else's module does when it is imported
        raise D2Error(
            f"{group.rsplit('.', 1)[1].removesuffix('s')} '{name}' ({points[name].value}) cannot be loaded "
            f"({said(failure)}): mend or remove the package that brings it"
        ) from failure


def _points(group: str) -> dict[str, EntryPoint]:
    if sys.version_info >= (3, 10):  # noqa: UP036
        return {point.name: point for point in entry_points(group=group)}
    return {point.name: point for point in entry_points().get(group, ())}

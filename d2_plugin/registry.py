"""Backbones and adapters by name, from entry points: a third party adds one with no edit here."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from d2_plugin.errors import unknown_name

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
    if name not in points:
        raise unknown_name(group.rsplit(".", 1)[1].removesuffix("s"), name, points)
    return points[name].load()


def _points(group: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=group)}

"""Sweeps over stiff and extreme cases, in float32 and float64."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form
from d2_plugin.commands.arguments.study_form import study_form


def form(words: list[str]) -> Form:
    """What `d2 stability` takes."""
    return study_form("d2 stability", "benchmarks.stability.sweep", "StabilitySettings")

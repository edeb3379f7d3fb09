"""One page of everything measured: plots, tables, images."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form
from d2_plugin.commands.arguments.study_form import study_form


def form(words: list[str]) -> Form:
    """What `d2 report` takes."""
    return study_form("d2 report", "d2_plugin.runs.report.report", "ReportSettings")

"""What is installed, what is missing for which feature, and which compiler and caches are used."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 doctor` takes: nothing."""
    from d2_plugin.runs.installation import report

    return Form("d2 doctor", __doc__ or "", (), lambda given: report())

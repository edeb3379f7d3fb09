"""Write a trained run as a web page that plays it, or as files that other viewers open."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 export` takes."""
    from d2_plugin.viewing.export.export import Export, run

    return Form.of("d2 export", __doc__, Export, run)

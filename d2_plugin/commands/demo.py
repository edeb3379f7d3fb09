"""A synthetic recording, trained by the backbone alone and with D2: a table, an image and a player."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 demo` takes."""
    from d2_plugin.viewing.demo import Demo, run

    return Form.of("d2 demo", __doc__, Demo, run)

"""A page in the browser that shows a run, a recording or a depth prior, to be moved through in space and time."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 view` takes."""
    from d2_plugin.viewing.live.show import ViewSettings, run

    return Form.of("d2 view", __doc__, ViewSettings, run)

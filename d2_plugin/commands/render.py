"""A video of a run: its held-out cameras, or a camera that moves; depth, errors, several runs beside each other."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 render` takes."""
    from d2_plugin.viewing.videos.plan import RenderSettings
    from d2_plugin.viewing.videos.render import run

    return Form.of("d2 render", __doc__, RenderSettings, run)

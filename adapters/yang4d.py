"""From the bundled Yang-style backbone to the contract."""

from __future__ import annotations

from d2_plugin.backbones.yang4d import Yang4D

from .watched import WatchedModel


class Yang4DAdapter(WatchedModel[Yang4D]):
    """One `Yang4D` instance as a `d2_plugin.protocol.Backbone`."""

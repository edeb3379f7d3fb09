"""What the adapters of the bundled backbones share: they watch one model's choke points and remember its render."""

from __future__ import annotations

from typing import Generic, TypeVar

import torch
from torch import Tensor

from d2_plugin.backbones.model import SplatModel
from d2_plugin.protocol import RasterSettings, Render, ResizeListener, Splats, View

Model = TypeVar("Model", bound=SplatModel)


class WatchedModel(Generic[Model]):
    """Wraps one model: its two structural functions report every change, its renders are remembered.

    An adapter of a bundled backbone adds `insert`; everything else of the contract is here.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._listeners: list[ResizeListener] = []
        self._rendered: tuple[View, Tensor, Tensor] | None = None
        self._watch(model)

    @property
    def settings(self) -> RasterSettings:
        """Constants of the backbone's rasterizer."""
        return self.model.settings.raster

    def __len__(self) -> int:
        return len(self.model)

    def view(self, camera: View) -> View:
        """The bundled trainer's cameras are views already."""
        return camera

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable."""
        return self.model.slice_at(view)

    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True."""
        self.model.select(torch.nonzero(~mask).squeeze(-1))

    def on_resize(self, listener: ResizeListener) -> None:
        """Register a listener for every structural change, the backbone's own densification included."""
        self._listeners.append(listener)

    def rendered_depth(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Depth sum and alpha of the render the trainer has just made of this view, or None; hands it out once."""
        rendered, self._rendered = self._rendered, None
        if rendered is None or rendered[0] is not view:
            return None
        return rendered[1:]

    def _watch(self, model: Model) -> None:
        """Override the choke points on the instance: internal calls go through `self.`, so all are seen."""
        append, select, render = model.append, model.select, model.render

        def watched_append(rows: dict[str, Tensor]) -> None:
            before = torch.arange(len(model), device=model.gaussians.device)
            append(rows)
            self._tell(torch.cat([before, before.new_full((len(model) - len(before),), -1)]))

        def watched_select(index: Tensor) -> None:
            select(index)
            self._tell(index)

        def watched_render(view: View, background: Tensor | None = None) -> Render:
            output = render(view, background)
            self._rendered = (view, output.depth_sum, output.alpha) if output.alpha.requires_grad else None
            return output

        model.append, model.select, model.render = watched_append, watched_select, watched_render

    def _tell(self, index: Tensor) -> None:
        for listener in self._listeners:
            listener(index)

"""What the adapters of the bundled backbones share: they observe one model's changes and keep its renders."""

from __future__ import annotations

from typing import Generic, TypeVar

import torch
from torch import Tensor

from d2_plugin.backbones.model import Observer, SplatModel
from d2_plugin.gaussians.trained import trained_tensors
from d2_plugin.protocol import Points, RasterSettings, Render, Splats, View

from .shared import Renders, Resizing

Model = TypeVar("Model", bound=SplatModel)


class WatchedModel(Resizing, Observer, Generic[Model]):
    """One model, of which every change of its Gaussians and every render is observed."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model
        self._renders: Renders[tuple[Tensor, Tensor]] = {}
        model.observers.append(self)

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

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] of the sliced Gaussians as the view's camera saw them."""
        return self.model.colors_seen(view, splats)

    def trained(self) -> dict[str, Tensor]:
        """The tensors that are trained, by name."""
        return dict(trained_tensors(self.model))

    def behind(self, render: Render, view: View) -> Render:
        """The render with the model's background as the view's camera saw it."""
        return self.model.behind(render, view)

    def insert(self, points: Points) -> int:
        """Insert isotropic Gaussians at the points, living around the time of their frame; returns their number."""
        self.model.append(self.model.initial_rows(points, self.model.settings, self.model.duration))
        return len(points.positions)

    def remove(self, mask: Tensor) -> None:
        """Delete the rows where `mask` [N] is True."""
        self.model.select(torch.nonzero(~mask).squeeze(-1))

    def rendered_depth(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Depth sum and alpha of the trainer's render of this view in the present step, or None; hands it out once."""
        return self._renders.pop((view.camera, view.frame), None)

    def resized(self, index: Tensor) -> None:
        """The model's Gaussians changed, by its own densification or through this adapter."""
        self._report(index)

    def rendered(self, view: View, render: Render) -> None:
        """Keep a render; one without gradients only drops the earlier render of its view."""
        self._renders.pop((view.camera, view.frame), None)
        if render.alpha.requires_grad:
            self._renders[view.camera, view.frame] = render.depth_sum, render.alpha

    def optimized(self) -> None:
        """The parameters changed: renders made with the old ones are out of date and forgotten."""
        self._renders.clear()

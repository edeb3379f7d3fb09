"""What `check_backbone` tries the contract on: a small backbone, its cameras, and what else there is to check."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from d2_plugin.protocol import Backbone, Points, View


@dataclass(frozen=True)
class Example:
    """A small backbone to try the contract on; what is left out is not checked.

    `cameras` are the trainer's own camera objects, at least two, of which each must see some of the Gaussians.
    """

    backbone: Backbone
    cameras: Sequence[object]
    optimizers: Sequence[torch.optim.Optimizer] | Callable[[], Sequence[torch.optim.Optimizer]] = ()
    """Optimizers of the per-Gaussian parameters, or a function that finds them where edits replace them."""
    render: Callable[[object], object] | None = None
    """The trainer's own render of a camera, after which the backbone may hand out `rendered_depth`."""
    grow: Callable[[], object] | None = None
    """The backbone's own densification: must change the number of Gaussians."""
    state_dict: Callable[[], Mapping[str, Any]] | None = None
    load_state_dict: Callable[[Mapping[str, Any]], object] | None = None

    @property
    def views(self) -> list[View]:
        """The cameras as views."""
        return [self.backbone.view(camera) for camera in self.cameras]

    @property
    def parameters(self) -> list[tuple[torch.optim.Optimizer, Tensor]]:
        """Every parameter that is optimized, with its optimizer."""
        optimizers = self.optimizers() if callable(self.optimizers) else self.optimizers
        return [(o, p) for o in optimizers for group in o.param_groups for p in group["params"]]


Check = Callable[[Example], Iterator[str]]
"""One sentence for each violation."""


@torch.no_grad()
def some_points(example: Example, view: View) -> Points:
    """A few points in front of a camera, a little off Gaussians that it sees."""
    splats = example.backbone.slice_at(view)
    depth = splats.means @ (pose := view.T_camera_world.to(splats.means))[2, :3] + pose[2, 3]
    near = splats.means[depth > example.backbone.settings.near][:8]
    width = 0.02 * depth.abs().median().clamp(min=1e-3)
    ones = near.new_ones(len(near))
    return Points(near + width, torch.full_like(near, 0.5), ones * view.time, ones * width, ones * 0.4)


def some_rows(example: Example) -> Tensor:
    """Every third row."""
    view = example.views[0]
    return torch.arange(len(example.backbone), device=view.K.device) % 3 == 1

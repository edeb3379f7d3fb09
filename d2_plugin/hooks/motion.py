"""Supervision of motion: what the cameras would have seen between two instants (an addition to the paper).

Images alone say nothing of the time between them: Gaussians that fade in and out, one set for each instant, reproduce
every trained image, and between two instants show both. The prior knows where each surface went, and so what lies
1 to 3 quarters of the way (`d2_plugin.priors.between`). That image supervises whatever moves the Gaussians, a
space-time covariance, a deformation network, polynomials, through `slice_at`; and `densify` inserts what is missing
halfway.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from d2_plugin.hooks.hook import Context, Hook, HookConfig
from d2_plugin.hooks.prior import Kept
from d2_plugin.protocol import Backbone, Label, View, call_optional
from d2_plugin.rasterizer import rasterize
from d2_plugin.settings import Range, Share

log = logging.getLogger(__name__)

ORDER = (2, 1, 2, 3)
"""Quarters of the way in turn: halfway, farthest from what is trained, twice as often."""


@dataclass(frozen=True)
class MotionConfig(HookConfig):
    """Supervision between instants. Each time costs a render, with gradients, of the part that moves."""

    weight: Annotated[float, Range(0, 1e6)] = 1.0
    """Weight beside the trainer's own photometric loss."""
    ssim_weight: Share = 0.2
    """Share of D-SSIM in it; the rest is L1."""
    insert: bool = True
    """Whether `densify` also inserts what moves at instants halfway."""


class Motion(Hook):
    """Adds the photometric loss between each view of the present step and the same camera's next instant."""

    config: MotionConfig

    def __init__(self, config: MotionConfig) -> None:
        super().__init__(config)
        self._colorless = False

    def loss(self, context: Context) -> Tensor | None:
        """The weight times the mean over the views after which something is known; None where there are none."""
        if self.config.weight == 0 or self._colorless:
            return None
        quarter = ORDER[context.step // self.config.every % len(ORDER)]
        pairs = [context.prior.underway(view, context.instants(view.camera), quarter) for view in context.views]
        terms = [self._term(context.backbone, *pair) for pair in pairs if pair is not None]
        known = [term for term in terms if term is not None]
        return self.config.weight * torch.stack(known).mean() if known else None

    def _term(self, backbone: Backbone, view: View, kept: Kept) -> Tensor | None:
        from d2_plugin.gaussians.photometric import photometric_loss  # a trainer without this hook needs none of it

        splats = backbone.slice_at(view)
        colors, prior = call_optional(backbone, "colors", view, splats), kept.maps.codes
        if colors is None or prior.colors is None:
            log.warning("motion supervises nothing: the backbone has no `colors`, see d2_plugin.protocol.Backbone")
            self._colorless = True
            return None
        render = rasterize(splats, colors, view, backbone.settings)
        shown, labels = (part.to(view.K.device, non_blocking=True) for part in (prior.colors, prior.labels))
        image = shown.to(render.color) / 255
        # A background that is not known shows what the image shows.
        unknown = render._replace(color=render.color + (1 - render.alpha)[..., None] * image)
        color = call_optional(backbone, "behind", render, view, default=unknown).color
        moved = (labels != Label.CONFLICT)[..., None]
        return photometric_loss(color, torch.where(moved, image, color.detach()), self.config.ssim_weight)

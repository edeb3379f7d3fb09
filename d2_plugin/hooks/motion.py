"""Supervision of motion: what the cameras would have seen between two instants (an addition to the paper).

Images alone say nothing of the time between them: Gaussians that fade in and out, one set for each instant, reproduce
every trained image, and between two instants show both. The prior knows where each surface went, and so what lies
1 to 3 quarters of the way (`d2_plugin.priors.between`). That image supervises whatever moves the Gaussians, a
space-time covariance, a deformation network, polynomials, through `slice_at`; and `densify` inserts what is missing
halfway.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from d2_plugin.hooks.hook import Context, HookConfig, ImageHook
from d2_plugin.protocol import Label, View, call_optional
from d2_plugin.settings import Range

ORDER = (2, 1, 2, 3)
"""Quarters of the way in turn: halfway, farthest from what is trained, twice as often."""


@dataclass(frozen=True)
class MotionConfig(HookConfig):
    """Supervision between instants. Each time costs a render, with gradients, of the part that moves."""

    weight: Annotated[float, Range(0, 1e6)] = 1.0
    """Weight beside the trainer's own photometric loss."""
    insert: bool = True
    """Whether `densify` also inserts what moves at instants halfway."""


class Motion(ImageHook):
    """Adds the photometric loss between each view of the present step and the same camera's next instant."""

    config: MotionConfig

    def term(self, context: Context, view: View) -> Tensor | None:
        """See `ImageHook.term`."""
        from d2_plugin.gaussians.photometric import photometric_loss  # a trainer without this hook needs none of it

        quarter = ORDER[context.step // self.config.every % len(ORDER)]
        pair = context.prior.underway(view, context.instants(view.camera), quarter)
        if pair is None:
            return None
        between, prior = pair[0], pair[1].maps.codes
        if prior.colors is None or (drawn := self.drawn(context.backbone, between)) is None:
            return None
        shown, labels = (part.to(view.K.device, non_blocking=True) for part in (prior.colors, prior.labels))
        image = shown.to(drawn.color) / 255
        # A background that is not known shows what the image shows.
        unknown = drawn._replace(color=drawn.color + (1 - drawn.alpha)[..., None] * image)
        color = call_optional(context.backbone, "behind", drawn, between, default=unknown).color
        moved = (labels != Label.CONFLICT)[..., None]
        return photometric_loss(color, torch.where(moved, image, color.detach()))

"""Supervision of motion: what the cameras would have seen between two instants (an addition to the paper).

Images alone say nothing of the time between them: Gaussians that fade in and out, one set for each instant, reproduce
every trained image, and between two instants show both. The prior knows where each surface went, and so what lies
1 to 3 quarters of the way (`d2_plugin.priors.between`). That image supervises whatever moves the Gaussians, a
space-time covariance, a deformation network, polynomials, through `slice_at`; and `densify` inserts what is missing
halfway.

A Gaussian that lives for an instant is trained by the views of that instant alone, few of the steps of a long
recording. So what moves is looked at again there: in each step at other instants of the camera as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from d2_plugin.hooks.hook import Context, HookConfig, ImageHook
from d2_plugin.protocol import Label, View, call_optional
from d2_plugin.settings import Range, Steps

LOOKS = 40
"""Looks at what moves at each instant, beside those of the trainer's own views, that a long run makes."""

SHORT = 1000
"""Steps below which there are none: what stands still has as much to learn."""

MOST_AGAIN = 4
"""Most of them in one step."""

ORDER = (2, 1, 2, 3)
"""Quarters of the way in turn: halfway, farthest from what is trained, twice as often."""

LATE = 0.7
"""Share of a run after which images on the way count less: they are as wrong as the flow they come from, and what was
seen has the last word."""

LATE_WEIGHT = 0.25
"""What they count then."""


@dataclass(frozen=True)
class MotionConfig(HookConfig):
    """Supervision between instants. Each time costs a render, with gradients, of the part that moves."""

    weight: Annotated[float, Range(0, 1e6)] = 1.0
    """Weight beside the trainer's own photometric loss."""
    insert: bool = True
    """Whether `densify` also inserts what moves at instants halfway."""
    late: Steps | None = None
    """First step at which images on the way count a quarter; none: they count in full to the end."""
    again: Annotated[float, Range(0, 1)] = 0.0
    """For each instant of the camera, how many others are looked at in a step, where they move: a whole number in all,
    four at most. Runs of a thousand steps and more have 40 / their steps, which is none below 25 instants for each
    thousand steps."""

    @classmethod
    def for_iterations(cls, iterations: int) -> MotionConfig:
        """The defaults, less late in the run; in one that is not short, with looks at other instants."""
        again = LOOKS / iterations if iterations >= SHORT else 0.0
        return cls(late=max(1, round(LATE * iterations)), again=again)


class Look(NamedTuple):
    """What a view of what moves is compared with."""

    view: View
    image: Tensor  # [H, W, 3] uint8
    known: Tensor | None = None  # [H, W] bool; none: everywhere
    weight: float = 1.0


class Motion(ImageHook):
    """Adds the photometric loss on the way from each view of the step to its camera's next instant, and at others."""

    config: MotionConfig

    def term(self, context: Context, view: View) -> Tensor | None:
        """See `ImageHook.term`."""
        terms = [self._compared(context, look) for look in self._looks(context, view)]
        known = [term for term in terms if term is not None]
        return torch.stack(known).sum() if known else None

    def _looks(self, context: Context, view: View) -> Iterator[Look]:
        seen, quarter = context.instants(view.camera), ORDER[context.step // self.config.every % len(ORDER)]
        pair = context.prior.underway(view, seen, quarter)
        if pair is not None and (maps := pair[1].maps.codes).colors is not None:
            late = self.config.late is not None and context.step >= self.config.late
            yield Look(pair[0], maps.colors, maps.labels != Label.CONFLICT, LATE_WEIGHT if late else 1.0)
        for _ in range(min(int(self.config.again * len(seen)), MOST_AGAIN)):
            other = seen[int(torch.randint(len(seen), (1,), generator=context.generator, device="cpu"))]
            moving = context.prior.moving(other, seen)
            if moving is not None:
                yield Look(*moving)

    def _compared(self, context: Context, look: Look) -> Tensor | None:
        """The photometric loss of what a view shows against its image where that is known."""
        from d2_plugin.gaussians.photometric import photometric_loss  # a trainer without this hook needs none of it

        if (drawn := self.drawn(context.backbone, look.view)) is None:
            return None
        image = look.image.to(look.view.K.device, non_blocking=True).to(drawn.color) / 255
        # A background that is not known shows what the image shows.
        unknown = drawn._replace(color=drawn.color + (1 - drawn.alpha)[..., None] * image)
        color = call_optional(context.backbone, "behind", drawn, look.view, default=unknown).color
        if look.known is not None:
            image = torch.where(look.known.to(look.view.K.device, non_blocking=True)[..., None], image, color.detach())
        return look.weight * photometric_loss(color, image)

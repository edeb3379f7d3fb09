"""Where images move: a Gaussian that is inserted there must not outlive its instant."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from d2_plugin.hooks.hook import Context
from d2_plugin.protocol import View

CHANGED = 24
"""A channel, of 0 to 255, that differs by more than this from the camera's median over time shows something else."""
INSTANTS = 9
"""Of how many instants the median is taken."""
FEWEST = 3
"""With fewer there is no median to differ from."""
MOST_MOVING = 0.5
"""Where more of an image differs, it is the light or the camera that changes, and nothing is known."""


class Motion:
    """Compares the images of a camera that stands still with their median over time, from the prior's colours."""

    def __init__(self) -> None:
        self._still: dict[str, tuple[tuple[int, ...], Tensor]] = {}

    def intervals(self, view: View, context: Context) -> Tensor | None:
        """The time from one instant to the next at pixels that move, infinite elsewhere: [H, W], the views' unit.

        None where nothing is known: a prior without colours, fewer than three instants, a camera that moves, light
        that changes.
        """
        seen = [other for other in context.instants(view.camera) if _same_place(view, other)]
        prior, still = context.prior(view), self._median(view.camera, seen[:INSTANTS], context)
        if prior is None or prior.colors is None or still is None:
            return None
        moving = ((prior.colors.short() - still.short()).abs() > CHANGED).any(-1)
        if moving.float().mean() > MOST_MOVING:
            return None
        return torch.where(moving, _interval(seen), torch.inf)

    def _median(self, camera: str, views: Sequence[View], context: Context) -> Tensor | None:
        """The median image uint8 [H, W, 3] of some views of a camera."""
        frames = tuple(view.frame for view in views)
        if camera not in self._still or self._still[camera][0] != frames:
            priors = [prior for view in views if (prior := context.prior(view)) is not None]
            images = [prior.colors for prior in priors if prior.colors is not None]
            if len(images) < FEWEST:
                return None
            self._still[camera] = frames, torch.stack(images).median(0).values
        return self._still[camera][1]


def _same_place(view: View, other: View) -> bool:
    return torch.equal(view.T_camera_world, other.T_camera_world) and torch.equal(view.K, other.K)


def _interval(views: Sequence[View]) -> float:
    """The shortest time between two instants; infinite if there is but one."""
    times = torch.tensor(sorted({view.time for view in views}), dtype=torch.float64)
    return float(times.diff().min()) if len(times) > 1 else torch.inf

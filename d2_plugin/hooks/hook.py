"""What a hook is: two verbs, `loss` and `edit`, that return data; D2Hooks applies it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from d2_plugin.hooks.expected import check_device, check_splats
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.protocol import Backbone, DepthPrior, Edit, Splats, Survey, View, call_optional
from d2_plugin.rasterizer import Render, rasterize, survey
from d2_plugin.settings import Every, Settings, Steps

log = logging.getLogger(__name__)

FREE_SIGMAS = 3.0
"""Space is known to be free up to D* less this many standard deviations."""


Chosen = TypeVar("Chosen", bound="HookConfig")


@dataclass(frozen=True)
class HookConfig(Settings):
    """When a hook runs. A hook's own settings are a subclass of this, in the file of the hook."""

    start: Steps = 1
    """First step at which it may run."""
    stop: Steps | None = None
    """First step at which it no longer runs; none: it runs to the end."""
    every: Every = 1
    """Steps from one time to the next."""

    @classmethod
    def for_iterations(cls: type[Chosen], iterations: int) -> Chosen:
        """The defaults with a schedule that fits a run of so many steps."""
        return cls()

    def due(self, step: int) -> bool:
        """Whether the hook runs at `step` (1-based, as trainers count): from start to before stop, every so many."""
        return self.start <= step and (self.stop is None or step < self.stop) and (step - self.start) % self.every == 0

    def due_when_retired(self, step: int) -> bool:
        """Whether it is due at `step` even if its evaluations had nothing to change any more."""
        return False

    def left(self, step: int) -> float:
        """How often it is due from `step` on, if it is then; infinite where it runs to the end, 0 after it."""
        return math.inf if self.stop is None else max(0, -(-(self.stop - step) // self.every))


class Surveyed(NamedTuple):
    """One view of an evaluation: its sliced Gaussians, its prior, and the compositing weights."""

    view: View
    splats: Splats
    prior: DepthPrior
    survey: Survey


@dataclass(frozen=True)
class Context:
    """Everything a hook may look at in one step; `evaluation` is computed once and shared by all hooks."""

    step: int
    """Of the schedules, see `d2_plugin.protocol.schedule_step`."""
    backbone: Backbone
    views: Sequence[View]
    """The views of the present training step."""
    prior: PriorLoader
    generator: torch.Generator
    sample: Callable[[], Sequence[View]] = field(default=tuple)
    """The views to evaluate when structure is edited: a stratified sample of all training views."""
    instants: Callable[[str], Sequence[View]] = field(default=lambda camera: ())
    """The views of a camera that were trained on so far, in the order in which they were first seen."""
    beside: Callable[[View], Sequence[View]] = field(default=lambda view: (view,))
    """A view of each camera that was trained on so far, of the frame of a given one where that is known; none where a
    camera moves: others of its instants may see what this one does not."""
    inserts_halfway: bool = False
    """Whether `halfway` is evaluated as well."""

    @cached_property
    def evaluation(self) -> list[Surveyed]:
        """The sampled views that have a prior, surveyed without gradients."""
        pairs = [(view, self.prior(view)) for view in self.sample()]
        return [self._survey(view, prior) for view, prior in pairs if prior is not None]

    @cached_property
    def halfway(self) -> list[Surveyed]:
        """What lies halfway from each view of `evaluation` to the camera's next instant, where it is to be known."""
        seen = [surveyed.view for surveyed in self.evaluation] if self.inserts_halfway else []
        pairs = [pair for view in seen if (pair := self.prior.underway(view, self.instants(view.camera))) is not None]
        return [self._survey(view, self.prior.believed(kept.prior(view.K.device))) for view, kept in pairs]

    @torch.no_grad()
    def _survey(self, view: View, prior: DepthPrior) -> Surveyed:
        splats = self.backbone.slice_at(view)
        check_splats(splats, len(self.backbone), inserting=False)
        check_device(splats, view)
        near_edge = prior.near_edge(FREE_SIGMAS) if prior.measured else None
        return Surveyed(view, splats, prior, survey(splats, view, prior, self.backbone.settings, near_edge=near_edge))


class Hook:
    """Base of all hooks: does nothing. One that keeps state per Gaussian implements `follow` and `reset`."""

    settling = 0
    """Evaluations at the start in which the hook only gathers evidence and so cannot change anything yet."""

    def __init__(self, config: Any) -> None:
        """`config` is an instance of the hook's own `HookConfig`."""
        self.config = config

    def loss(self, context: Context) -> Tensor | None:
        """A term to add to the training loss of this step, or None."""

    def edit(self, context: Context) -> Edit | None:
        """Rows to remove and points to insert, or None."""

    def follow(self, index: Tensor) -> None:
        """The Gaussians changed: row r was row index[r] before, -1 for a new one."""

    def reset(self) -> None:
        """The Gaussians changed without a report: forget per-Gaussian state."""

    def state_dict(self) -> dict[str, Tensor]:
        """What an exact continuation needs."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state_dict()`."""


class ImageHook(Hook):
    """Base of hooks that compare what the backbone shows with an image of their own; their settings have a `weight`."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self._colorless = False

    def loss(self, context: Context) -> Tensor | None:
        """The weight times the mean over the views of which something is known; None where there are none."""
        if self.config.weight == 0 or self._colorless:
            return None
        known = [term for view in context.views if (term := self.term(context, view)) is not None]
        return self.config.weight * torch.stack(known).mean() if known else None

    def term(self, context: Context, view: View) -> Tensor | None:
        """The loss of one view of the present step; None where nothing is known of it."""

    def drawn(self, backbone: Backbone, view: View) -> Render | None:
        """What the backbone's Gaussians show, with gradients. None, and a warning, where it has no colours."""
        splats = backbone.slice_at(view)
        colors = call_optional(backbone, "colors", view, splats)
        if colors is None:
            name = type(self).__name__.lower()
            log.warning("%s supervises nothing: the backbone has no `colors`, see d2_plugin.protocol.Backbone", name)
            self._colorless = True
            return None
        return rasterize(splats, colors, view, backbone.settings)

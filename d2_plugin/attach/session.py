"""What the launcher does to a running trainer: attach, add the loss inside render, edit after zero_grad."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.hooks.prior import Store
from d2_plugin.hooks.reports import RunLog
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import Backbone, schedule_step

log = logging.getLogger(__name__)

Adapter = Callable[..., Backbone]
Place = tuple[str, str]
"""A module of the repository and one of its attributes."""

MUCH_GROWTH = 3
"""Gaussians of the trainer's own densification for each one that D2 inserted, above which the log names them."""


@dataclass
class Objects:
    """The trainer's own objects, as they come into being."""

    model: Any = None
    options: Any = None
    """What `training_setup` was given: the optimization parameters."""
    state: Any = None
    """Of gsplat's strategy."""
    scene: Any = None
    """What knows the cameras."""
    gaussians: Any = None
    """gsplat 1.6's GaussianScene."""
    deform: Any = None
    given: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = field(default_factory=dict)
    """By the name of the field, what its instance was made from: arguments, and named ones."""


@dataclass(frozen=True)
class Original:
    """A module that a repository builds in CUDA, and ours that can take its place.

    `file` is where it lies inside the repository, relative to the script; None for an installed package. `loader` is
    the module and its attribute that hold what the package itself loaded or built, where that need not be `name`.
    """

    name: str
    stand_in: str
    file: str | None = None
    loader: Place | None = None


@dataclass(frozen=True)
class Recipe:
    """What the launcher must know of one codebase."""

    adapter: str
    """Name among the entry points `d2_plugin.adapters`."""
    build: Callable[[Adapter, Objects], Backbone]
    originals: tuple[Original, ...]
    models: tuple[Place, ...] = (("scene.gaussian_model", "GaussianModel"),)
    """Classes that the repository may train, where they are imported from."""
    renderers: tuple[Place, ...] = (("gaussian_renderer", "render"),)
    """Functions that draw a training view."""
    session: type[Session] | None = None
    """What attaches to it, where it is not a GaussianModel with training_setup."""
    script: str = "train.py"
    """What trains, relative to the repository."""
    folders: tuple[str, ...] = ()
    """Folders below the script's that it puts on the path itself."""
    averages_gradients: bool = False
    """Whether the trainer divides the gradients of a batch afterwards, instead of each loss before."""
    prepare: Callable[[], None] | None = None
    """Called before the script runs, once stand-ins are in place."""
    before_loss: Callable[[Any, Mapping[str, Any]], None] | None = None
    """Hands the adapter what it needs from the named arguments of each render."""
    seen: Mapping[str, Place] = field(default_factory=lambda: {"scene": ("scene", "Scene")})
    """Classes whose latest instance is remembered, by its field of `Objects`."""

    def backbone(self, objects: Objects) -> Backbone:
        """The adapter, made from the trainer's objects."""
        return self.build(registry.load(registry.ADAPTERS, self.adapter), objects)


class AddGradient(torch.autograd.Function):
    """The image unchanged; its backward pass also sends `weight` into `term`, as if weight * term were in the loss.

    So a trainer that computes its own loss from this image minimises the sum, and none of its code is edited.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, term: Tensor, weight: float) -> Tensor:
        """`image` as it is."""
        ctx.weight, ctx.like = weight, term.new_empty(())
        return image.view_as(image)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        """The image's own gradient, and the term's."""
        return gradient, torch.full_like(ctx.like, ctx.weight), None


class Session:
    """One run of a foreign train.py with D2 attached.

    The number of the iteration is what the trainer gives to `update_learning_rate(iteration)`, before or after
    rendering. Where it has no such method, iterations are counted from 1.
    A trainer that draws a batch takes the mean of its loss, and D2's term is divided by the batch size in the same way.
    That size is the number of images in the step before, so the first step has no term.
    """

    def __init__(
        self, recipe: Recipe, config: D2Config | Path | None, store: Store | None = None, exported: Path | None = None
    ) -> None:
        """A configuration in a file gets its schedules once the trainer says how long it runs; None: a bare run."""
        self.recipe, self.config, self.store, self.exported = recipe, config, store, exported
        self.objects = Objects()
        self.hooks: D2Hooks | None = None
        self._iteration, self._counted, self._drawn, self._batch = 0, False, 0, 0
        self._growth_logged = False

    def wrap(self) -> None:
        """Override the choke points of the repository's modules; call before its script runs.

        In a bare run the trainer's objects are remembered, and what they compute is not touched.
        """
        for name, place in self.recipe.seen.items():
            self.keep_instances(attribute_of(*place), name)
        for place in self.recipe.models:
            model = attribute_of(*place)
            wrap_attribute(model, "training_setup", self._attaching)
            if hasattr(model, "update_learning_rate"):
                wrap_attribute(model, "update_learning_rate", self._counting)
        for place in self.recipe.renderers if self.config is not None else ():
            attribute_of(*place)  # says what is missing
            wrap_attribute(importlib.import_module(place[0]), place[1], self._rendering)

    def keep_instances(self, kind: type, name: str) -> None:
        """Keep the latest instance of a class, and what it was made from, under `name` of the objects."""

        def remembering(original: Callable[..., None], instance: Any, *arguments: Any, **named: Any) -> None:
            # Before the call: a scene builds its model inside, and may be asked for before it returns.
            setattr(self.objects, name, instance)
            self.objects.given[name] = arguments, named
            original(instance, *arguments, **named)

        wrap_attribute(kind, "__init__", remembering)  # a foreign class, overridden for all its instances

    def end(self) -> None:
        """Log what D2 did, at the end of the script."""
        if self.hooks is not None:
            self.hooks.log.end()
        elif self.config is not None:
            log.warning("the trainer never called training_setup: D2 was not attached")

    def _attaching(
        self, training_setup: Callable[..., Any], model: Any, options: Any, *arguments: Any, **named: Any
    ) -> Any:
        self.objects.model, self.objects.options = model, options
        result = training_setup(model, options, *arguments, **named)
        if self.config is not None:
            self.attach(getattr(options, "iterations", None))
            self._watch(model.optimizer)
        return result

    def attach(self, iterations: int | None) -> None:
        """Make the adapter and the hooks of the objects seen, for a run of that many iterations."""
        backbone = self.recipe.backbone(self.objects)
        config = self._configured(iterations, partial(schedule_step, backbone))
        self.hooks = D2Hooks.from_config(config, backbone, self.store, iterations=iterations)
        self._iteration, self._counted, self._drawn, self._batch = 0, False, 0, 0

    def _configured(self, iterations: int | None, pace: Callable[[int], int]) -> D2Config:
        assert self.config is not None
        config = self.config if isinstance(self.config, D2Config) else D2Config.from_toml(self.config, iterations, pace)
        exported = self.exported or self._export_read(config)
        return config if exported is None else replace(config, exported=str(exported))

    def _export_read(self, config: D2Config) -> Path | None:
        """The export of the prior's recording that the trainer reads, by the folder that its Scene was given."""
        source = self._source()
        if source is None or config.prior is None or config.exported is not None or self.store is not None:
            return None
        from d2_plugin.store.exported import export_read

        return export_read(Path(config.prior), Path(source))

    def _source(self) -> str | None:
        arguments, _ = self.objects.given.get("scene", ((None,), {}))
        return getattr(next(iter(arguments), None), "source_path", None)

    def _counting(
        self, update_learning_rate: Callable[..., Any], model: Any, iteration: int, *arguments: Any, **named: Any
    ) -> Any:
        self._iteration, self._counted = iteration, True
        return update_learning_rate(model, iteration, *arguments, **named)

    def _rendering(
        self, render: Callable[..., Mapping[str, Any]], camera: Any, model: Any, *arguments: Any, **named: Any
    ) -> Mapping[str, Any]:
        if self.hooks is not None and model is self.objects.model and torch.is_grad_enabled():
            self.hooks.prefetch([camera])  # its prior is read while it is drawn
        package = render(camera, model, *arguments, **named)
        training = torch.is_grad_enabled() and package["render"].requires_grad
        if self.hooks is None or model is not self.objects.model or not training:
            return package
        if self.recipe.before_loss is not None:
            self.recipe.before_loss(self.hooks.backbone, named)
        return self._with_loss(self.hooks, camera, package)

    def _with_loss(self, hooks: D2Hooks, camera: Any, package: Mapping[str, Any]) -> Mapping[str, Any]:
        self._drawn += 1
        rendered = getattr(hooks.backbone, "rendered", None)
        view = rendered(camera, package) if rendered is not None else camera
        term = self._term(hooks, [view])
        if self._batch and term is not None:
            weight = 1.0 if self.recipe.averages_gradients else 1 / self._batch
            return {**package, "render": AddGradient.apply(package["render"], term, weight)}
        return package

    def _term(self, hooks: D2Hooks, views: list[Any]) -> Tensor | None:
        """D2's loss of views in the present iteration, if it has a gradient."""
        if not self._counted:
            self._iteration, self._counted = self._iteration + 1, True
        term = hooks.loss(self._iteration, views)
        return term if isinstance(term, Tensor) and term.requires_grad else None

    def _watch(self, optimizer: torch.optim.Optimizer) -> None:
        """Run `D2Hooks.step` after the first zero_grad behind every step; on this instance alone."""
        stepped = [False]

        def stepping(step: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
            stepped[0] = True
            return step(*arguments, **named)

        def zeroing(zero_grad: Callable[..., None], *arguments: Any, **named: Any) -> None:
            zero_grad(*arguments, **named)
            if stepped[0]:
                stepped[0] = False
                self._after_step()

        wrap_attribute(optimizer, "step", stepping)
        wrap_attribute(optimizer, "zero_grad", zeroing)

    def _after_step(self) -> None:
        if self.hooks is None:
            return
        self.hooks.step(self._iteration)
        self._note_growth(self.hooks.log)
        self._counted, self._drawn, self._batch = False, 0, self._drawn

    def _note_growth(self, done: RunLog) -> None:
        """Log once that the trainer's own densification outgrows what D2 inserted; it splits inserted ones as well."""
        if 0 < done.inserted * MUCH_GROWTH < done.others and not self._growth_logged:
            self._growth_logged = True
            made = f"made {done.others} Gaussians beside the {done.inserted} that D2 inserted"
            sentence = "iteration %d: the trainer's own densification has %s: set densify.max_gaussians"
            log.warning(sentence, done.last_step, made)


def wrap_attribute(owner: Any, name: str, around: Callable[..., Any]) -> None:
    """Replace a function of a module, class or object by `around`, which gets the original before the arguments."""
    original = getattr(owner, name)

    @wraps(original)
    def wrapped(*arguments: Any, **named: Any) -> Any:
        return around(original, *arguments, **named)

    setattr(owner, name, wrapped)


def attribute_of(module: str, attribute: str) -> Any:
    """An attribute of one of the repository's modules; its own imports may fail with errors of their own."""
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and not f"{module}.".startswith(f"{error.name}."):
            raise
        raise D2Error(
            f"the script's folder has no {module}.{attribute} ({error}): give the repository that the script belongs to"
        ) from None

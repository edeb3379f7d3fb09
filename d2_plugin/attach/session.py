"""What the launcher does to a running trainer: attach, add the loss inside render, edit after zero_grad."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin.attach.recipes import Objects, Recipe, adapter_of
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.hooks.prior import Store
from d2_plugin.plugin import D2Hooks

log = logging.getLogger(__name__)


def remember(recipe: Recipe, objects: Objects) -> None:
    """Keep the trainer's own objects as they come into being; what they compute is not touched."""
    for name, place in recipe.seen.items():
        keep_instances(found_in(*place), name, objects)
    for place in recipe.models:
        model = found_in(*place)
        model.training_setup = _keeping(model.training_setup, objects)


def keep_instances(kind: type, name: str, objects: Objects) -> None:
    """Keep the latest instance of a class, and what it was made from, under `name`."""
    original = kind.__init__  # type: ignore[misc]

    @wraps(original)
    def remembering(instance: Any, *arguments: Any, **named: Any) -> None:
        # Before the call: a scene builds its model inside, and may be asked for before it returns.
        setattr(objects, name, instance)
        objects.given[name] = arguments, named
        original(instance, *arguments, **named)

    kind.__init__ = remembering  # type: ignore[misc]  # a foreign class, overridden for all its instances


def _keeping(training_setup: Callable[..., Any], objects: Objects) -> Callable[..., Any]:
    @wraps(training_setup)
    def keeping(model: Any, options: Any, *arguments: Any, **named: Any) -> Any:
        objects.model, objects.options = model, options
        return training_setup(model, options, *arguments, **named)

    return keeping


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
        self, recipe: Recipe, config: D2Config | Path, store: Store | None = None, exported: Path | None = None
    ) -> None:
        """A configuration in a file gets its schedules once the trainer says how long it runs."""
        self.recipe, self.config, self.store, self.exported = recipe, config, store, exported
        self.objects = Objects()
        self.hooks: D2Hooks | None = None
        self.writer: Any = None
        self._iteration, self._told = 0, False
        self._drawn, self._batch = 0, 0

    remember = staticmethod(remember)
    """How this kind of script's own objects are kept; for a bare run as well."""

    def wrap(self) -> None:
        """Override the choke points of the repository's modules; call before its script runs."""
        self.remember(self.recipe, self.objects)
        for place in self.recipe.models:
            model = found_in(*place)
            model.training_setup = self._attaching(model.training_setup)
            if hasattr(model, "update_learning_rate"):
                model.update_learning_rate = self._listening(model.update_learning_rate)
        for module, attribute in self.recipe.renderers:
            setattr(importlib.import_module(module), attribute, self._rendering(found_in(module, attribute)))

    def summary(self) -> str:
        """What D2 did, in one line."""
        if self.hooks is None:
            return "the trainer never called training_setup: D2 was not attached"
        return self.hooks.log.summary()

    def end(self) -> None:
        """Say what D2 did, at the end of the script."""
        if self.hooks is None:
            log.warning("%s", self.summary())
        else:
            self.hooks.log.end()

    def _attaching(self, training_setup: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(training_setup)
        def attaching(model: Any, options: Any, *arguments: Any, **named: Any) -> Any:
            result = training_setup(model, options, *arguments, **named)
            backbone = self.recipe.build(adapter_of(self.recipe), self.objects)
            iterations = getattr(options, "iterations", None)
            self.hooks = D2Hooks.from_config(
                self._configured(iterations), backbone, self.store, iterations=iterations, writer=self.writer
            )
            self._watch(model.optimizer)
            self._iteration, self._told, self._drawn, self._batch = 0, False, 0, 0
            return result

        return attaching

    def _configured(self, iterations: int | None) -> D2Config:
        config = self.config if isinstance(self.config, D2Config) else D2Config.from_toml(self.config, iterations)
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
        """The folder that the trainer reads."""
        arguments, _ = self.objects.given.get("scene", ((), {}))
        return getattr(arguments[0], "source_path", None) if arguments else None

    def _listening(self, update_learning_rate: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(update_learning_rate)
        def listening(model: Any, iteration: int, *arguments: Any, **named: Any) -> Any:
            self._iteration, self._told = iteration, True
            return update_learning_rate(model, iteration, *arguments, **named)

        return listening

    def _rendering(self, render: Callable[..., Mapping[str, Any]]) -> Callable[..., Mapping[str, Any]]:
        @wraps(render)
        def rendering(camera: Any, model: Any, *arguments: Any, **named: Any) -> Mapping[str, Any]:
            package = render(camera, model, *arguments, **named)
            training = torch.is_grad_enabled() and package["render"].requires_grad
            if self.hooks is None or model is not self.objects.model or not training:
                return package
            if self.recipe.heard is not None:
                self.recipe.heard(self.hooks.backbone, named)
            return self._with_loss(self.hooks, camera, package)

        return rendering

    def _with_loss(self, hooks: D2Hooks, camera: Any, package: Mapping[str, Any]) -> Mapping[str, Any]:
        if not self._told:
            self._iteration, self._told = self._iteration + 1, True
        self._drawn += 1
        rendered = getattr(hooks.backbone, "rendered", None)
        view = rendered(camera, package) if rendered is not None else camera
        term = hooks.loss(self._iteration, [view])
        if self._batch and isinstance(term, Tensor) and term.requires_grad:
            weight = 1.0 if self.recipe.averages_gradients else 1 / self._batch
            return {**package, "render": AddGradient.apply(package["render"], term, weight)}
        return package

    def _watch(self, optimizer: torch.optim.Optimizer) -> None:
        """Run `D2Hooks.step` after the first zero_grad behind every step; on this instance alone."""
        step, zero_grad, stepped = optimizer.step, optimizer.zero_grad, [False]

        @wraps(step)
        def stepping(*arguments: Any, **named: Any) -> Any:
            stepped[0] = True
            return step(*arguments, **named)

        @wraps(zero_grad)
        def zeroing(*arguments: Any, **named: Any) -> None:
            zero_grad(*arguments, **named)
            if stepped[0]:
                stepped[0] = False
                self._after_step()

        optimizer.step, optimizer.zero_grad = stepping, zeroing  # type: ignore[method-assign]

    def _after_step(self) -> None:
        if self.hooks is None:
            return
        self.hooks.step(self._iteration)
        self._told, self._drawn, self._batch = False, 0, self._drawn


def found_in(module: str, attribute: str) -> Any:
    """An attribute of one of the repository's modules; its own imports may fail with errors of their own."""
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and not f"{module}.".startswith(f"{error.name}."):
            raise
        raise D2Error(
            f"the script's folder has no {module}.{attribute} ({error}): give the repository that the script belongs to"
        ) from None

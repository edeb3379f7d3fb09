"""gsplat's `simple_trainer.py`, whose classes lie in the script itself: the choke points are those of gsplat's modules.

What is attached to is what `Strategy.check_sanity` and `initialize_state` are given and return; a training view is a
call of `rasterization` while gradients are on; a step ends with `step_post_backward`. Cameras have no names there, so a
view is known by its pose among those that the script's `Parser` read.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin.attach.recipes import Objects, Recipe, adapter_of
from d2_plugin.attach.session import AddGradient, Session, keep_instances, remember
from d2_plugin.errors import D2Error
from d2_plugin.plugin import D2Hooks

log = logging.getLogger(__name__)

STRATEGIES = ("DefaultStrategy", "MCMCStrategy")
PLACES = (("gsplat.rendering", "rasterization"), ("gsplat", "rasterization"))
"""Where scripts import it from."""


class Model(NamedTuple):
    """What is trained: parameters and optimizers by name."""

    splats: Any
    optimizers: Mapping[str, torch.optim.Optimizer]


def put_in_place() -> None:
    """Ours where gsplat's kernels are missing, and one process instead of one for each GPU."""
    stand_in = "d2_plugin.compat.gsplat"
    if getattr(sys.modules.get("gsplat.csrc"), "__name__", "") == stand_in:
        ours = importlib.import_module(stand_in)
        for module, attribute in PLACES:
            setattr(importlib.import_module(module), attribute, ours.rasterization)
        log.warning("gsplat.rasterization: %s stands in for it", stand_in)
    distributed: Any = importlib.import_module("gsplat.distributed")
    distributed.cli = _one_process
    _without_lpips()


def _one_process(main: Callable[..., Any], settings: Any, verbose: bool = False) -> bool:
    if torch.cuda.device_count() > 1:
        raise D2Error(
            f"gsplat would train on {torch.cuda.device_count()} GPUs, and D2 follows one: set CUDA_VISIBLE_DEVICES=0"
        )
    main(0, 0, 1, settings)
    return True


def _without_lpips() -> None:
    """simple_trainer.py makes its LPIPS before it trains, and that needs torchvision and a download."""
    if importlib.util.find_spec("torchvision") is not None and not _is_stand_in("torchvision"):
        return
    module: Any = importlib.import_module("torchmetrics.image.lpip")
    module.LearnedPerceptualImagePatchSimilarity = importlib.import_module("d2_plugin.compat.vision").NoLpips
    log.warning("torchvision is missing: LPIPS is not measured, its values are NaN")


def _is_stand_in(package: str) -> bool:
    spec = importlib.util.find_spec(package)
    return spec is not None and spec.origin is None and not spec.submodule_search_locations


def remember_gsplat(recipe: Recipe, objects: Objects) -> None:
    """As `session.remember`: the parser of the data, the parameters, and the settings of the script."""
    remember(recipe, objects)
    if importlib.util.find_spec("gsplat.scene") is not None:  # since 1.6
        keep_instances(importlib.import_module("gsplat.scene").GaussianScene, "gaussians", objects)
    strategies = importlib.import_module("gsplat.strategy")
    for name in STRATEGIES:
        kind = getattr(strategies, name)
        kind.check_sanity = _keeping_model(kind.check_sanity, objects)
    distributed: Any = importlib.import_module("gsplat.distributed")
    distributed.cli = _keeping_settings(distributed.cli, objects)


def _keeping_model(check_sanity: Callable[..., Any], objects: Objects) -> Callable[..., Any]:
    @wraps(check_sanity)
    def keeping(strategy: Any, params: Any, optimizers: Any, *arguments: Any, **named: Any) -> Any:
        objects.model = Model(params, optimizers)
        return check_sanity(strategy, params, optimizers, *arguments, **named)

    return keeping


def _keeping_settings(cli: Callable[..., Any], objects: Objects) -> Callable[..., Any]:
    @wraps(cli)
    def keeping(main: Callable[..., Any], settings: Any, *arguments: Any, **named: Any) -> Any:
        objects.options = settings
        return cli(main, settings, *arguments, **named)

    return keeping


class GsplatSession(Session):
    """One run of simple_trainer.py with D2 attached; steps are counted from 1."""

    remember = staticmethod(remember_gsplat)

    def wrap(self) -> None:
        """Override the choke points; call before the script runs."""
        self.remember(self.recipe, self.objects)
        strategies = importlib.import_module("gsplat.strategy")
        for name in STRATEGIES:
            kind = getattr(strategies, name)
            kind.initialize_state = self._attaching_to(kind.initialize_state)
            kind.step_post_backward = self._stepping(kind.step_post_backward)
        for module, attribute in PLACES:
            found = importlib.import_module(module)
            setattr(found, attribute, self._drawing(getattr(found, attribute)))

    def _source(self) -> str | None:
        """What the script's parser reads."""
        return getattr(self.objects.scene, "data_dir", None)

    def _attaching_to(self, initialize_state: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(initialize_state)
        def attaching(*arguments: Any, **named: Any) -> Any:
            state = self.objects.state = initialize_state(*arguments, **named)
            backbone = self.recipe.build(adapter_of(self.recipe), self.objects)
            iterations = getattr(self.objects.options, "max_steps", None)
            self.hooks = D2Hooks.from_config(
                self._configured(iterations), backbone, self.store, iterations=iterations, writer=self.writer
            )
            self._iteration, self._told, self._drawn, self._batch = 0, False, 0, 1
            return state

        return attaching

    def _stepping(self, step_post_backward: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(step_post_backward)
        def stepping(*arguments: Any, **named: Any) -> Any:
            result = step_post_backward(*arguments, **named)
            self._after_step()
            return result

        return stepping

    def _drawing(self, rasterization: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(rasterization)
        def drawing(*arguments: Any, **named: Any) -> Any:
            drawn = rasterization(*arguments, **named)
            if self.hooks is None or not (torch.is_grad_enabled() and drawn[0].requires_grad):
                return drawn
            size = {"width": named["width"], "height": named["height"]}
            poses = torch.linalg.inv(named["viewmats"].detach())
            seen = [{"camtoworld": pose, "K": K, **size} for pose, K in zip(poses, named["Ks"])]
            return self._with_term(self.hooks, seen, drawn)

        return drawing

    def _with_term(self, hooks: D2Hooks, seen: list[dict[str, Any]], drawn: Any) -> Any:
        self._iteration, self._told = self._iteration + (not self._told), True
        term = hooks.loss(self._iteration, seen)
        if isinstance(term, Tensor) and term.requires_grad:
            return (AddGradient.apply(drawn[0], term, 1.0), *drawn[1:])
        return drawn

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
from collections.abc import Callable
from typing import Any

import torch

from d2_plugin.attach.session import AddGradient, Session, wrap_attribute
from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings

log = logging.getLogger(__name__)

STRATEGIES = ("DefaultStrategy", "MCMCStrategy")
PLACES = (("gsplat.rendering", "rasterization"), ("gsplat", "rasterization"))
"""Where scripts import it from."""


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
    spec = importlib.util.find_spec("torchvision")
    if spec is not None and (spec.origin is not None or spec.submodule_search_locations):  # no stand-in
        return
    module: Any = importlib.import_module("torchmetrics.image.lpip")
    module.LearnedPerceptualImagePatchSimilarity = importlib.import_module("d2_plugin.compat.vision").NoLpips
    log.warning("torchvision is missing: LPIPS is not measured, its values are NaN")


class GsplatSession(Session):
    """One run of simple_trainer.py with D2 attached; steps are counted from 1."""

    def wrap(self) -> None:
        """Override the choke points; call before the script runs."""
        super().wrap()
        if importlib.util.find_spec("gsplat.scene") is not None:  # since 1.6
            self.keep_instances(importlib.import_module("gsplat.scene").GaussianScene, "gaussians")
        strategies, distributed = (importlib.import_module(f"gsplat.{name}") for name in ("strategy", "distributed"))
        wrap_attribute(distributed, "cli", self._keeping_settings)
        for name in STRATEGIES:
            kind = getattr(strategies, name)
            wrap_attribute(kind, "check_sanity", self._keeping_model)
            wrap_attribute(kind, "initialize_state", self._attaching_to)
            wrap_attribute(kind, "step_post_backward", self._stepping)
        for module, attribute in PLACES if self.config is not None else ():
            wrap_attribute(importlib.import_module(module), attribute, self._drawing)

    def _source(self) -> str | None:
        return getattr(self.objects.scene, "data_dir", None)

    def _keeping_settings(self, cli: Callable[..., Any], main: Any, settings: Any, *more: Any, **named: Any) -> Any:
        self.objects.options = settings
        return cli(main, settings, *more, **named)

    def _keeping_model(
        self, check_sanity: Callable[..., Any], strategy: Any, params: Any, optimizers: Any, *more: Any, **named: Any
    ) -> Any:
        self.objects.model = params, optimizers
        return check_sanity(strategy, params, optimizers, *more, **named)

    def _attaching_to(self, initialize_state: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        state = self.objects.state = initialize_state(*arguments, **named)
        if self.config is not None:
            self.attach(getattr(self.objects.options, "max_steps", None))
        return state

    def _stepping(self, step_post_backward: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        result = step_post_backward(*arguments, **named)
        self._after_step()
        return result

    def _drawing(self, rasterization: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        drawn = rasterization(*arguments, **named)
        if self.hooks is None or not (torch.is_grad_enabled() and drawn[0].requires_grad):
            return drawn
        if named.get("camera_model", "pinhole") != "pinhole":
            raise D2Error(f"D2 draws pinhole cameras alone, got camera_model '{named['camera_model']}': leave it out")
        constants = {"near": named.get("near_plane", 0.01), "blur": named.get("eps2d", 0.3)}
        antialiased = named.get("rasterize_mode") == "antialiased"
        self.hooks.backbone.settings = RasterSettings(**constants, antialiased=antialiased)
        size = {"width": named["width"], "height": named["height"]}
        poses = torch.linalg.inv_ex(named["viewmats"].detach()).inverse
        term = self._term(self.hooks, [{"camtoworld": pose, "K": K, **size} for pose, K in zip(poses, named["Ks"])])
        return drawn if term is None else (AddGradient.apply(drawn[0], term, 1.0), *drawn[1:])

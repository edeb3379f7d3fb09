"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

import logging
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, Label, View

from .camera_check import CameraCheck

log = logging.getLogger(__name__)


class Store(Protocol):
    """What the loader needs of a prior store (d2_plugin.priors.store.PriorStore).

    Where it also has `camera(camera, frame) -> CameraRecord | None`, views are checked against it.
    """

    def prior(self, camera: str, frame: int) -> DepthPrior | None: ...


JUDGES = 0.05
"""Largest sigma of a pixel that may judge a Gaussian: an error of 10 %, at which E_k saturates, is two of these."""


OUTLINE = 2
"""Pixels along the outline of a sky that say nothing: a Gaussian a pixel wide, two pixels inside of the surface, would
else stand in free space."""


@dataclass(frozen=True, eq=False)
class KnownPixels:
    """What may supervise one view: where something is known of D*, and how much; all [K]."""

    index: Tensor
    """int64, row * width + column."""
    depth: Tensor
    """float32, world units; at far pixels a lower bound."""
    sigma: Tensor
    """float32, relative standard deviation of the depth; 0 at far pixels and, in the paper, at verified ones."""
    far: Tensor
    """bool: only a depth in front of `depth` is wrong."""

    @cached_property
    def near(self) -> int:
        """How many are not far."""
        return int((~self.far).sum())


class PriorLoader:
    """Looks up D* by camera and frame, on the view's device; keeps the last few: memory must not grow with frames."""

    def __init__(self, store: Store, keep_bytes: int = 512 << 20) -> None:
        self.store, self.keep_bytes = store, keep_bytes
        self._kept: OrderedDict[tuple[str, int], DepthPrior | None] = OrderedDict()
        self._cameras = CameraCheck()
        self._without: set[str] = set()
        self._pixels: dict[tuple[str, int], KnownPixels] = {}

    def __call__(self, view: View) -> DepthPrior | None:
        """D* of the view, or None where the store has none; refuses one made for another size, K or pose."""
        key = (view.camera, view.frame)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        prior = self.store.prior(*key)
        if prior is None and view.camera not in self._without:
            self._without.add(view.camera)
            log.info("camera %s has no prior at frame %d: it is trained without D2 there", view.camera, view.frame)
        if prior is not None:
            self._check(view, prior)
            prior = _usable(DepthPrior._make(None if t is None else t.to(view.K.device) for t in prior))
        self._kept[key] = prior
        while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > self.keep_bytes:
            dropped, _ = self._kept.popitem(last=False)
            self._pixels.pop(dropped, None)
        return prior

    def known(self, view: View) -> KnownPixels | None:
        """The pixels of the view of whose depth something is known, or None where there is not one."""
        key, prior = (view.camera, view.frame), self(view)
        if prior is None:
            return None
        if key not in self._pixels:
            self._pixels[key] = _known(prior)
        pixels = self._pixels[key]
        return pixels if len(pixels.index) else None

    def _check(self, view: View, prior: DepthPrior) -> None:
        height, width = prior.depth.shape
        if (width, height) != (view.width, view.height):
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} is {width}x{height} pixels but the view is "
                f"{view.width}x{view.height}: build the prior at the resolution that is trained at"
            )
        describe = getattr(self.store, "camera", None)
        record = describe(view.camera, view.frame) if describe is not None else None
        if record is not None:
            self._cameras.check(view, record, prior.depth)


def _usable(prior: DepthPrior) -> DepthPrior:
    """The same prior, empty where the depth is no finite positive number: no store can put NaN into a loss.

    It is also empty at the outline of what is far: a Gaussian of the surface in front spills over it. Pixels judge
    Gaussians where sigma is small, whatever their label.
    """
    usable = torch.isfinite(prior.depth) & (prior.depth > 0) & ~(prior.far & ~_inside(prior.far))
    prior = prior._replace(labels=torch.where(usable, prior.labels, int(Label.EMPTY)))
    if prior.sigma is None or prior.reliability is not None:
        return prior
    return prior._replace(reliability=(prior.support & (prior.sigma <= JUDGES)).to(prior.depth))


def _inside(far: Tensor) -> Tensor:
    """The far pixels [H, W] at least `OUTLINE` pixels inside of what is far; the rim of the picture is no outline."""
    others = (~far).float()[None, None]
    return F.max_pool2d(others, 2 * OUTLINE + 1, stride=1, padding=OUTLINE)[0, 0] == 0


def _known(prior: DepthPrior) -> KnownPixels:
    """Pixels with a finite sigma, and far ones; without sigma, as in the paper, the trusted ones."""
    known = prior.trusted if prior.sigma is None else prior.support & torch.isfinite(prior.sigma)
    index = torch.nonzero((known | prior.far).flatten()).squeeze(1)
    depth, far = prior.depth.flatten()[index], prior.far.flatten()[index]
    sigma = torch.zeros_like(depth) if prior.sigma is None else prior.sigma.flatten()[index].masked_fill(far, 0)
    return KnownPixels(index, depth, sigma, far)


def _bytes(prior: DepthPrior | None) -> int:
    """Of a prior on the device, and of as many known pixels as it may have."""
    if prior is None:
        return 0
    return sum(t.numel() * t.element_size() for t in prior if t is not None) + 17 * prior.depth.numel()

"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, Label, View

from .camera_check import CameraCheck


class Store(Protocol):
    """What the loader needs of a prior store (d2_plugin.priors.store.PriorStore).

    Where it also has `camera(camera, frame) -> CameraRecord | None`, views are checked against it.
    """

    def prior(self, camera: str, frame: int) -> DepthPrior | None: ...


@dataclass(frozen=True, eq=False)
class TrustedPixels:
    """What may supervise one view: where D* is trusted (see `DepthPrior.trusted`), and D* there."""

    index: Tensor
    """[K] int64, row * width + column."""
    depth: Tensor
    """[K] float32, world units."""


class PriorLoader:
    """Looks up D* by camera and frame, on the view's device; keeps the last few: memory must not grow with frames."""

    def __init__(self, store: Store, keep_bytes: int = 512 << 20) -> None:
        self.store, self.keep_bytes = store, keep_bytes
        self._kept: OrderedDict[tuple[str, int], DepthPrior | None] = OrderedDict()
        self._cameras = CameraCheck()
        self._pixels: dict[tuple[str, int], TrustedPixels] = {}

    def __call__(self, view: View) -> DepthPrior | None:
        """D* of the view, or None where the store has none; refuses one made for another size, K or pose."""
        key = (view.camera, view.frame)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        prior = self.store.prior(*key)
        if prior is not None:
            self._check(view, prior)
            prior = _with_depth(DepthPrior._make(None if t is None else t.to(view.K.device) for t in prior))
        self._kept[key] = prior
        while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > self.keep_bytes:
            dropped, _ = self._kept.popitem(last=False)
            self._pixels.pop(dropped, None)
        return prior

    def trusted(self, view: View) -> TrustedPixels | None:
        """The trusted pixels of the view, or None where there is not one."""
        key, prior = (view.camera, view.frame), self(view)
        if prior is None:
            return None
        if key not in self._pixels:
            index = torch.nonzero(prior.trusted.flatten()).squeeze(1)
            self._pixels[key] = TrustedPixels(index, prior.depth.flatten()[index])
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


def _with_depth(prior: DepthPrior) -> DepthPrior:
    """The same prior, empty where the depth is no finite positive number: no store can put NaN into a loss."""
    usable = torch.isfinite(prior.depth) & (prior.depth > 0)
    return prior if usable.all() else prior._replace(labels=torch.where(usable, prior.labels, int(Label.EMPTY)))


def _bytes(prior: DepthPrior | None) -> int:
    """Of a prior on the device, and of as many trusted pixels as it may have."""
    if prior is None:
        return 0
    return sum(t.numel() * t.element_size() for t in prior if t is not None) + 12 * prior.depth.numel()

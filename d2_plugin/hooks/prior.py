"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

from collections import OrderedDict
from typing import Protocol

import torch

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, View


class Store(Protocol):
    """What the loader needs of a prior store (d2_plugin.priors.store.PriorStore)."""

    def prior(self, camera: str, frame: int) -> DepthPrior | None: ...


class PriorLoader:
    """Looks up D* by camera and frame; keeps the last few on the device, since memory must not grow with frames."""

    def __init__(self, store: Store, device: torch.device, keep_bytes: int = 512 << 20) -> None:
        self.store, self.device, self.keep_bytes = store, device, keep_bytes
        self._kept: OrderedDict[tuple[str, int], DepthPrior | None] = OrderedDict()

    def __call__(self, view: View) -> DepthPrior | None:
        """D* of the view, or None where the store has none; refuses one of another size than the view."""
        key = (view.camera, view.frame)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        prior = self.store.prior(*key)
        if prior is not None:
            self._check(view, prior)
            prior = DepthPrior(*(None if t is None else t.to(self.device) for t in prior))
        self._kept[key] = prior
        while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > self.keep_bytes:
            self._kept.popitem(last=False)
        return prior

    @staticmethod
    def _check(view: View, prior: DepthPrior) -> None:
        height, width = prior.depth.shape
        if (width, height) != (view.width, view.height):
            raise D2Error(
                f"the prior of camera {view.camera}, frame {view.frame} is {width}x{height} pixels but the view is "
                f"{view.width}x{view.height}: build the prior at the resolution that is trained at"
            )


def _bytes(prior: DepthPrior | None) -> int:
    return 0 if prior is None else sum(t.numel() * t.element_size() for t in prior if t is not None)

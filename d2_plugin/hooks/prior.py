"""The prior loader: D* of a view, from disk, checked against the camera that asks for it."""

from __future__ import annotations

import logging
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

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


Belief = Literal["all", "stereo", "nothing"]
"""What of a prior is believed: `all` of it, `stereo` alone, or `nothing`."""

BELIEVED: dict[str, tuple[Label, ...]] = {"stereo": (Label.VERIFIED,), "nothing": ()}
"""Labels of the pixels that keep their depth, where not all do."""


def believed(prior: DepthPrior, belief: Belief) -> DepthPrior:
    """The prior with those pixels left empty whose source is not believed."""
    if belief == "all":
        return prior
    kept = torch.zeros_like(prior.labels, dtype=torch.bool)
    for label in BELIEVED[belief]:
        kept |= prior.labels == label
    depth, labels = (torch.where(kept, map_, torch.zeros_like(map_)) for map_ in (prior.depth, prior.labels))
    return prior._replace(depth=depth, labels=labels)


JUDGES = 0.05
"""Largest sigma of a pixel that may judge a Gaussian: an error of 10 %, at which E_k saturates, is two of these."""


OUTLINE = 2
"""Pixels along the outline of a sky that say nothing: a Gaussian a pixel wide, two pixels inside of the surface, would
else stand in free space."""


NEAR, FAR = 1, 2
"""What `KnownMaps.kind` says where something is known."""


class KnownMaps(NamedTuple):
    """What may supervise one view, pixel by pixel, [H * W]; depth and sigma mean nothing where nothing is known."""

    kind: Tensor
    """uint8: 0 where nothing is known, `NEAR`, or `FAR`: there only a depth in front of `depth` is wrong."""
    depth: Tensor
    """World units; at far pixels a lower bound."""
    sigma: Tensor | None
    """Relative standard deviation of the depth; far pixels count as if it were 0, and all do where there is none."""


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

    @cached_property
    def count(self) -> int:
        """How many there are."""
        return len(self.index)

    def maps(self, numel: int) -> KnownMaps:
        """The same as maps of a view of so many pixels."""
        kind = torch.zeros(numel, dtype=torch.uint8, device=self.index.device)
        kind[self.index] = torch.where(self.far, FAR, NEAR).byte()
        depth, sigma = (part.new_zeros(numel).index_copy_(0, self.index, part) for part in (self.depth, self.sigma))
        return KnownMaps(kind, depth, sigma)

    @property
    def bytes(self) -> int:
        """The memory that they take."""
        return sum(part.numel() * part.element_size() for part in (self.index, self.depth, self.sigma, self.far))


class PriorPixels(KnownPixels):
    """Those of a prior: its own maps, not copies of them; the list is made where somebody asks for it."""

    def __init__(self, prior: DepthPrior) -> None:
        """Pixels with a finite sigma, and far ones; without sigma, as in the paper, the trusted ones."""
        known = prior.trusted if prior.sigma is None else prior.support & torch.isfinite(prior.sigma)
        kind = (known.byte() * NEAR + prior.far.byte() * FAR).flatten()
        sigma = None if prior.sigma is None else prior.sigma.flatten()
        self._maps: KnownMaps
        self.__dict__["_maps"] = KnownMaps(kind, prior.depth.flatten(), sigma)  # frozen, as a list of pixels is
        near, far = (int(torch.count_nonzero(kind == which)) for which in (NEAR, FAR))
        self.__dict__.update(near=near, count=near + far)

    @cached_property
    def index(self) -> Tensor:
        """See `KnownPixels`, as all that follows."""
        return torch.nonzero(self._maps.kind).squeeze(1)

    @cached_property
    def depth(self) -> Tensor:
        return self._maps.depth[self.index]

    @cached_property
    def sigma(self) -> Tensor:
        sigma = self._maps.sigma
        return torch.zeros_like(self.depth) if sigma is None else sigma[self.index].masked_fill(self.far, 0)

    @cached_property
    def far(self) -> Tensor:
        return self._maps.kind[self.index] == FAR

    def maps(self, numel: int) -> KnownMaps:
        """See `KnownPixels`; the size is the prior's."""
        assert numel == self._maps.kind.numel(), "the loader refuses priors of another size than the view's"
        return self._maps

    @property
    def bytes(self) -> int:
        """The memory that they take beside the prior."""
        made = (self._maps.kind, *(self.__dict__.get(name) for name in ("index", "depth", "sigma", "far")))
        return sum(part.numel() * part.element_size() for part in made if part is not None)


class PriorLoader:
    """Looks up D* by camera and frame, on the view's device; keeps the last few: memory must not grow with frames."""

    def __init__(self, store: Store, keep_bytes: int = 512 << 20, believe: Belief = "all") -> None:
        self.store, self.keep_bytes, self.believe = store, keep_bytes, believe
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
            prior = believed(DepthPrior._make(None if t is None else t.to(view.K.device) for t in prior), self.believe)
            prior = _usable(prior)
        self._kept[key] = prior
        while len(self._kept) > 1 and self._bytes() > self.keep_bytes:
            dropped, _ = self._kept.popitem(last=False)
            self._pixels.pop(dropped, None)
        return prior

    def known(self, view: View) -> KnownPixels | None:
        """The pixels of the view of whose depth something is known, or None where there is not one."""
        key, prior = (view.camera, view.frame), self(view)
        if prior is None:
            return None
        if key not in self._pixels:
            self._pixels[key] = PriorPixels(prior)
        pixels = self._pixels[key]
        return pixels if pixels.count else None

    def _bytes(self) -> int:
        tensors = [part for prior in self._kept.values() if prior is not None for part in prior if part is not None]
        held = sum(part.numel() * part.element_size() for part in tensors)
        return held + sum(pixels.bytes for pixels in self._pixels.values())

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

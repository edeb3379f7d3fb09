"""The maps of one prior, and the codes that a store keeps of them: depth and sigma as logarithms.

Logarithmic depth in 16 bits is exact to 1e-5 in a room and to 1.6e-4 from 1e-3 to 1e6; sigma in 8 bits is exact to 2 %.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, Label

PRIOR_DTYPE = np.dtype([("depth", "<u2"), ("label", "u1"), ("sigma", "u1"), ("color", "u1", (3,))])
"""The maps of a `FusedPrior` as they are stored, pixel by pixel."""

CODES = 65534  # depth codes 1..65535; 0 is empty


@dataclass(frozen=True)
class DepthRange:
    """The depths that codes 1 and 65535 stand for."""

    near: float
    far: float

    @classmethod
    def of(cls, depth: np.ndarray) -> DepthRange:
        """Smallest and largest depth of a map; 1, 1 where it has none."""
        known = depth[depth > 0]
        return cls(float(known.min()), float(known.max())) if known.size else cls(1.0, 1.0)

    def encode(self, depth: np.ndarray) -> np.ndarray:
        """Depth float [H, W] (0 = empty) to codes uint16."""
        known = depth > 0
        ratio = max(np.log(self.far / self.near), np.finfo(np.float64).tiny)
        position = np.log(np.where(known, depth, self.near).astype(np.float64) / self.near) / ratio
        return np.where(known, 1 + np.rint(position * CODES), 0).astype(np.uint16)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        """Codes uint16 to depth float32, 0 where empty; through a table, since a million exponentials are slow."""
        table = np.exp(np.linspace(np.log(self.near), np.log(self.far), CODES + 1))
        return np.concatenate([[0.0], table]).astype(np.float32)[codes]


SIGMA = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 254), [np.inf]]).astype(np.float32)
"""The relative standard deviations that the codes 0 to 255 stand for; 0 is the paper's certainty."""


def encode_sigma(sigma: np.ndarray) -> np.ndarray:
    """Relative standard deviation float [H, W] to codes uint8: the nearest there is, infinite above 1.

    Only an exact 0 stays 0; what is smaller than the smallest step becomes that step.
    """
    steps = np.log(SIGMA[254] / SIGMA[1])
    position = 1 + np.log(np.clip(sigma, SIGMA[1], 1) / SIGMA[1]) * (253 / steps)
    codes = np.where(sigma <= 1, np.rint(np.minimum(position, 254)), 255)
    return np.where(sigma == 0, 0, codes).astype(np.uint8)


UNKNOWN = 255
"""The code of an infinite sigma."""


class CodedPrior(NamedTuple):
    """The maps of one prior as they are stored and as they travel to the trainer's device: 7 bytes per pixel.

    `codes` has the fields of a `DepthPrior` [H, W], of which depth (int16, the bits of the uint16 codes) and sigma
    (uint8) are codes; with a range of None they are the numbers themselves. In single precision decoding adds less than
    2e-6 of a depth to the error of its code.
    """

    codes: DepthPrior
    range: DepthRange | None

    @classmethod
    def of(cls, stored: np.ndarray, depth_range: DepthRange) -> CodedPrior:
        """From an array of `PRIOR_DTYPE` [H, W]."""
        colors = np.empty((*stored.shape, 3), np.uint8)
        for channel in range(3):  # five times as fast as all three at once
            colors[..., channel] = stored["color"][..., channel]
        depth, labels, sigma = (np.array(stored[name]) for name in ("depth", "label", "sigma"))
        planes = depth.astype("<u2", copy=False).view(np.int16), labels, colors, sigma
        return cls(DepthPrior(*map(torch.from_numpy, planes)), depth_range)

    def decoded(self) -> DepthPrior:
        """Depth and sigma as numbers, on the device where the codes are."""
        if self.range is None:
            return self.codes
        depth, sigma = self.codes.depth.int() & 0xFFFF, self.codes.sigma
        step = np.log(self.range.far / self.range.near) / CODES
        depth = torch.where(depth > 0, self.range.near * torch.exp((depth - 1) * float(step)), 0.0)
        if sigma is not None:
            sigma = _sigmas_on(sigma.device).index_select(0, sigma.flatten().int()).view_as(sigma)
        return self.codes._replace(depth=depth, sigma=sigma)


@functools.cache
def _sigmas_on(device: torch.device) -> Tensor:
    return torch.from_numpy(SIGMA).to(device)


@dataclass(frozen=True, eq=False)
class FusedPrior:
    """All maps per pixel of D* of one view, as numpy arrays: what the construction fills and the store writes.

    `depth` [H, W] float32 is planar z, 0 where empty; `labels` [H, W] uint8 holds `Label`; `sigma` [H, W] float32 is
    the relative standard deviation of the depth, infinite where it is unknown; `colors` [H, W, 3] uint8 is the
    image that it was made for, None until the construction adds it.
    """

    depth: np.ndarray
    labels: np.ndarray
    sigma: np.ndarray
    colors: np.ndarray | None = None

    def sigmas(self) -> dict[str, float | None]:
        """Median sigma of the pixels that carry each label; None where it is infinite or there are none."""
        return {label.name.lower(): _finite_median(self.sigma[self.labels == label]) for label in Label}

    def shares(self) -> dict[str, float]:
        """Share of the pixels that carry each label."""
        counts = {label: np.count_nonzero(self.labels == label) for label in Label}
        return {label.name.lower(): counts[label] / self.labels.size for label in Label}


def _finite_median(values: np.ndarray) -> float | None:
    """Median of non-negative numbers [n]; None where it is infinite or there are none."""
    if 2 * np.count_nonzero(values < np.inf) <= values.size:
        return None
    return float(np.median(values))


def empty_prior(shape: tuple[int, int]) -> FusedPrior:
    """A prior without a depth anywhere, of a view that was refused."""
    return FusedPrior(np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.full(shape, np.inf, np.float32))


def check_maps(prior: FusedPrior, what: str) -> None:
    """Refuse maps of another size, type or range; `what` names the prior.

    Raises:
        D2Error: what is wrong.
    """
    depth, labels = prior.depth, prior.labels
    if depth.ndim != 2 or depth.shape != labels.shape:
        raise D2Error(f"{what} has depth {depth.shape} and labels {labels.shape}: both must be [H, W] of one size")
    if prior.colors is None or prior.colors.shape != (*depth.shape, 3):
        colors = "none" if prior.colors is None else str(prior.colors.shape)
        raise D2Error(f"{what} is {depth.shape} and its colours {colors}: build the prior at the image's size")
    bad = ~np.isfinite(depth) | (depth < 0)
    if bad.any():
        raise D2Error(f"{what} has {int(bad.sum())} depths that are NaN, infinite or negative: use 0 for unknown depth")
    if labels.max(initial=0) > max(Label):
        raise D2Error(f"{what} has label {int(labels.max())}: labels are 0 to {int(max(Label))}")
    if prior.sigma.shape != depth.shape or not (prior.sigma >= 0).all():
        raise D2Error(f"{what} has a sigma that is no map [H, W] of numbers >= 0: use infinity where nothing is known")
    supported = (labels != Label.EMPTY) & (labels != Label.CONFLICT)
    if not np.array_equal(supported, depth > 0):
        known = "mono-only, verified, agreed and far"
        raise D2Error(f"{what} has labels that contradict its depth: exactly {known} pixels have a depth")

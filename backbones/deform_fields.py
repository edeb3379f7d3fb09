"""The deformation field: where a canonical Gaussian is, how it is turned and how large it is at an instant.

After hustvl/4DGaussians: six planes at several resolutions, multiplied, and a small head. Two things are ours: grids
are small enough for a CPU, and the last layer starts at zero, so that motion starts from none.

It is evaluated for all N Gaussians at one instant: what depends on the instant alone is computed once. No gradient
flows from it to the positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from d2_plugin.errors import D2Error
from d2_plugin.settings import LearningRate, Range, Settings

SPLITS = (3, 4, 3)
"""Columns of the last layer: offsets of position, quaternion and log-scales."""

SPACE_PAIRS = ((0, 1), (0, 2), (1, 2))
"""Axes of the three planes of a HexPlane that lie in space: xy, xz, yz."""


class Offsets(NamedTuple):
    """What the field adds to the canonical parameters (4DGaussians: before their activations)."""

    positions: Tensor  # [N, 3] world units
    rotations: Tensor  # [N, 4] to raw quaternions
    log_scales: Tensor  # [N, 3]


HIDDEN = 64
"""Neurons of the hidden layer of `HexPlaneField`."""
PLANE_RATE = 1e-2
"""Learning rate of the planes at the first step."""
SMOOTH_SPACE, SMOOTH_TIME, STILL = 2e-4, 1e-3, 1e-4
"""Weights of the planes' squared second differences in space and along time, and of |1 - plane| of those with time: a
plane of ones changes nothing. Official names: plane_tv_weight, time_smoothness_weight, l1_time_planes."""


@dataclass(frozen=True)
class HexPlaneSettings(Settings):
    """Planes and network of `HexPlaneField`."""

    features: Annotated[int, Range(1, 64)] = 16
    """Channels of each plane."""
    resolutions: tuple[Annotated[int, Range(1, 512)], ...] = (16, 32)
    """Nodes of the planes along each axis of space, one number per level. Official: 64 and 128."""
    instants: Annotated[int, Range(1, 1000)] = 10
    """Nodes of the planes along time. Official: half the number of frames."""
    network_rate: LearningRate = 3e-4
    """Learning rate of the network at the first step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.resolutions) <= 8:
            raise D2Error(f"setting resolutions has {len(self.resolutions)} levels: give one to eight numbers of nodes")


class Box(NamedTuple):
    """The part of the world that the field is made for; `unit` is what its position offsets are measured in."""

    centre: Tensor  # [3]
    reach: Tensor  # [3] half of each side
    unit: float

    @classmethod
    def around(cls, positions: Tensor, unit: float) -> Box:
        """Of all points but the outermost hundredth on each side of each axis, a tenth larger; positions [N, 3]."""
        if not len(positions):
            return cls(positions.new_zeros(3), positions.new_full((3,), unit), unit)
        low, high = torch.quantile(positions[:: 1 + len(positions) // 1_000_000], positions.new_tensor([0.01, 0.99]), 0)
        return cls((low + high) / 2, 0.55 * (high - low).clamp(min=1e-3 * unit), unit)


class HexPlaneField(nn.Module):
    """Offsets of Gaussians at one instant, from their canonical positions: the product of six feature planes at each of
    several resolutions, into a small network."""

    centre: Tensor
    reach: Tensor
    unit: Tensor

    def __init__(self, box: Box, settings: HexPlaneSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("centre", box.centre.detach().clone())
        self.register_buffer("reach", box.reach.detach().clone())
        self.register_buffer("unit", torch.tensor(box.unit))
        self.settings = settings
        channels, instants = settings.features, settings.instants
        grids = [torch.empty(3, channels, r, r).uniform_(0.1, 0.5, generator=generator) for r in settings.resolutions]
        self.space = nn.ParameterList(grids)
        self.time = nn.ParameterList(torch.ones(3, channels, instants, r) for r in settings.resolutions)
        self.features = linear(channels * len(settings.resolutions), HIDDEN, generator)
        self.heads = nn.utils.skip_init(nn.Linear, HIDDEN, sum(SPLITS))
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)

    def forward(self, positions: Tensor, fraction: float) -> Offsets:
        """Offsets of `positions` [N, 3] (world; no gradient) at `fraction` of the duration, clamped to 0..1.

        Outside the box the planes keep their border values."""
        places = (positions.detach() - self.centre) / self.reach
        inside, instant = places.clamp(-1, 1).T.contiguous(), min(max(fraction, 0.0), 1.0)
        levels = [self._level(space, time, inside, instant) for space, time in zip(self.space, self.time)]
        place, turn, size = self.heads(F.relu(self.features(torch.cat(levels).T))).split(SPLITS, -1)
        return Offsets(self.unit * place, turn, size)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Two groups: planes and network."""
        planes = [*self.space, *self.time]
        network = [*self.features.parameters(), *self.heads.parameters()]
        return [
            {"params": planes, "lr": PLANE_RATE, "name": "planes"},
            {"params": network, "lr": self.settings.network_rate, "name": "network"},
        ]

    def regularization(self) -> Tensor:
        """Smooth planes, and nothing that changes in time without need (4DGaussians, regulation.py)."""
        space = sum(bend(plane, -1) + bend(plane, -2) for plane in self.space)
        time = sum(bend(plane, -2) for plane in self.time)
        still = sum((1 - plane).abs().mean() for plane in self.time)
        return SMOOTH_SPACE * space + SMOOTH_TIME * time + STILL * still

    @staticmethod
    def _level(space: Tensor, time: Tensor, places: Tensor, fraction: float) -> Tensor:
        """Features [C, N] of places [3, N] in -1..1, from planes [3, C, R, R] and [3, C, T, R]."""
        pairs = torch.stack([torch.stack([places[b], places[a]], -1) for a, b in SPACE_PAIRS])
        planes = F.grid_sample(space, pairs[:, None], align_corners=True, padding_mode="border")[:, :, 0]
        lines = at_instant(time, fraction)
        moving = lines @ hats(places, lines.shape[-1])
        x, y, z = planes * moving  # xy with zt's partner and so on: the product of all six is what counts
        return x * y * z


def at_instant(planes: Tensor, fraction: float) -> Tensor:
    """Lines [3, C, R]: planes [3, C, T, R] interpolated at `fraction` (0..1) of their time."""
    last = planes.shape[2] - 1
    before = min(int(fraction * last), max(last - 1, 0))
    weight = fraction * last - before
    return torch.lerp(planes[:, :, before], planes[:, :, min(before + 1, last)], weight)


def hats(places: Tensor, nodes: int) -> Tensor:
    """Weights [3, R, N] of linear interpolation at places [3, N] in -1..1 on R nodes.

    A line times these is its value at each place: on a CPU the dense product is faster than collecting two nodes each
    and, backwards, adding to them.
    """
    position = (places + 1) * ((nodes - 1) / 2)
    node = torch.arange(nodes, device=places.device, dtype=places.dtype)
    return F.relu(1 - (position[:, None] - node[:, None]).abs())


def bend(planes: Tensor, axis: int) -> Tensor:
    """Mean square of the second differences along an axis; 0 where there are fewer than three nodes."""
    if planes.shape[axis] < 3:
        return planes.new_zeros(())
    return torch.diff(planes, n=2, dim=axis).square().mean()


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer with torch's usual start, drawn from `generator`: the global random state stays as it is."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    bound = 1 / math.sqrt(inputs)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer

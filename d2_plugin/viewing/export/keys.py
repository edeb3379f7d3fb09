"""A moving scene of any model at key times, straight in between, with how far off that is.

Nothing is known of the model but its Gaussians at an instant. Between two keys a Gaussian's centre, opacity and the
Cholesky factor L of its covariance L L^T go straight: a mixture of factors is the factor of a covariance, and unlike
rotations and scales it has no axes to confuse. Keys are added where the straight line is worst, until it is good enough
or the size is used up. A Gaussian that never leaves its first key by more than `STILL` pixels has no keys.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from d2_plugin.viewing.export.ply import ALPHA_MIN
from d2_plugin.viewing.export.scene import ExportScene

STILL = 0.05
"""Pixels of a training image; what moves less counts as standing still."""
GOOD = 0.1
"""Pixels that one Gaussian in a hundred may be off between keys where the size allows it."""
SAMPLE = 20_000
"""Gaussians by which keys are chosen; the error that is reported is that of all."""
MANY = 10
"""Frames of which each one may be a key, and nothing between them."""
MOST_CHECKS = 8
"""Instants at which the error is measured at most: a large field takes seconds for each."""
MOST_STATES = 8_000_000
"""Gaussians times instants that are evaluated and kept, 40 bytes each: of 300,000 Gaussians, 26 instants."""


class State(NamedTuple):
    """All N Gaussians at one instant; opacity 0 where one does not exist."""

    positions: Tensor  # [N, 3] world
    factors: Tensor  # [N, 6] L: xx, yx, zx, yy, zy, zz
    opacities: Tensor  # [N]

    def select(self, rows: Tensor) -> State:
        """The Gaussians `rows`."""
        return State(*(part[rows] for part in self))


class Offset(NamedTuple):
    """How far off the straight lines are between keys, in pixels of the training camera nearest by."""

    median: float
    hundredth: float
    """Exceeded by one Gaussian in a hundred."""
    largest: float

    @classmethod
    def of(cls, pixels: Tensor) -> Offset:
        """Of distances [N] in pixels."""
        if not len(pixels):
            return cls(0.0, 0.0, 0.0)
        ordered = pixels.sort().values
        places = (len(ordered) // 2, min(int(0.99 * len(ordered)), len(ordered) - 1), len(ordered) - 1)
        return cls(*(float(ordered[place]) for place in places))

    def __str__(self) -> str:
        return f"median {self.median:.3f}, 99 % {self.hundredth:.3f}, largest {self.largest:.2f} pixels"


@dataclass(frozen=True, eq=False)
class Keys:
    """N Gaussians, the first of which move: centres of the first `moving`, shape and opacity too of `changing`."""

    times: tuple[float, ...]
    start: State
    """Of all N, at the first key."""
    rows: Tensor
    """[N] which of the model's Gaussians each one is."""
    moving: int
    changing: int
    states: tuple[State, ...]
    """At each key: positions of the first `moving`, factors and opacities of the first `changing`."""
    offset: Offset

    def at(self, time: float) -> State:
        """All N at an instant; before the first key and after the last one it stands still."""
        i = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(len(self.times) - 2, 0)))
        j = min(i + 1, len(self.times) - 1)
        span = self.times[j] - self.times[i]
        share = min(max((time - self.times[i]) / span, 0.0), 1.0) if span > 0 else 0.0
        mixed = State(*(torch.lerp(a, b, share) for a, b in zip(self.states[i], self.states[j])))
        return State(*(torch.cat([part, whole[len(part) :]]) for part, whole in zip(mixed, self.start)))


def cholesky(covariances: Tensor) -> Tensor:
    """L [M, 6] (xx, yx, zx, yy, zy, zz) with L L^T the covariances [M, 6]; a flat one gets a small thickness."""
    xx, xy, xz, yy, yz, zz = covariances.double().unbind(-1)
    least = 1e-12 * torch.stack([xx, yy, zz]).amax(0).clamp(min=1e-30)
    a = torch.maximum(xx, least).sqrt()
    b, c = xy / a, xz / a
    d = torch.maximum(yy - b * b, least).sqrt()
    e = (yz - b * c) / d
    f = torch.maximum(zz - c * c - e * e, least).sqrt()
    return torch.stack([a, b, c, d, e, f], -1)


def covariances_of(factors: Tensor) -> Tensor:
    """Covariances [M, 6] xx xy xz yy yz zz of factors [M, 6]."""
    a, b, c, d, e, f = factors.unbind(-1)
    return torch.stack([a * a, a * b, a * c, b * b + d * d, b * c + d * e, c * c + e * e + f * f], -1)


def state_at(scene: ExportScene, time: float, before: State | None = None) -> State:
    """All Gaussians at `time`; one that does not exist then stays where it was `before`, with opacity 0."""
    splats, count = scene.splats_at(time), len(scene.harmonics.coefficients)
    positions = torch.zeros(count, 3).double() if before is None else before.positions.clone()
    factors = torch.zeros(count, 6).double() if before is None else before.factors.clone()
    finite = torch.isfinite(torch.cat([splats.means, splats.covariances, splats.opacities[:, None]], 1)).all(1)
    rows = splats.rows[finite]
    positions[rows] = splats.means[finite].double()
    factors[rows] = cholesky(splats.covariances[finite])
    opacities = torch.zeros(count).double()
    opacities[rows] = splats.opacities[finite].double()
    return State(positions, factors, opacities)


def bake(scene: ExportScene, most_keys: Callable[[int, int], int]) -> Keys:
    """The scene at key times, which are frames or, where these are few, also halfway between them.

    `most_keys` says how many there may be, from the numbers of Gaussians that move and that change their shape.
    """
    frames, count = scene.seconds, len(scene.harmonics.coefficients)
    times = list(frames) if len(frames) > MANY else sorted({*frames, *_middles(frames)})
    most = int(np.clip(MOST_STATES // max(count, 1), 12, len(times)))
    times = [times[i] for i in np.unique(np.linspace(0, len(times) - 1, most).round().astype(int))]
    travel = _Travel(scene, times)
    rank = torch.where(travel.changes, 0, torch.where(travel.moves, 1, 2))
    order = torch.from_numpy(morton_order(travel.first.positions.numpy()))
    order = order[travel.shown[order]]
    rows = order[torch.sort(rank[order], stable=True).indices]
    changing, moving = int((rank[rows] == 0).sum()), int((rank[rows] < 2).sum())
    chosen = _choose_keys(times, travel, most_keys(moving, changing))
    states = []
    for time in chosen:
        now = State(*(part[rows].double() for part in travel.states[times.index(time)]))
        states.append(State(now.positions[:moving], now.factors[:changing], now.opacities[:changing]))
    keys = Keys(tuple(chosen), travel.first.select(rows), rows, moving, changing, tuple(states), Offset(0, 0, 0))
    between = [time for time in sorted({*times, *_middles(chosen)}) if time not in set(chosen)]
    off = _offset(keys, scene, between[:: -(-len(between) // MOST_CHECKS) or 1], travel.scale)
    return replace(keys, offset=off)


class _Travel:
    """What is known of each Gaussian after all times were visited."""

    def __init__(self, scene: ExportScene, times: Sequence[float]) -> None:
        state = self.first = state_at(scene, times[0])
        count = len(state.positions)
        far, changed, faded, scale = (torch.zeros(count).double() for _ in range(4))
        strongest = state.opacities
        self.sample = torch.arange(0, count, 1 + count // SAMPLE)
        """Rows by which keys are chosen."""
        self.states = list[State]()
        """At each time, float32."""
        for time in times:
            state = state_at(scene, time, state)
            scale = torch.maximum(scale, scene.pixels_per_unit(state.positions))
            far = torch.maximum(far, (state.positions - self.first.positions).norm(dim=-1))
            changed = torch.maximum(changed, (state.factors - self.first.factors).norm(dim=-1))
            faded = torch.maximum(faded, (state.opacities - self.first.opacities).abs())
            strongest = torch.maximum(strongest, state.opacities)
            self.states.append(State(*(part.float() for part in state)))
        # Outside every image a moving Gaussian is held to what the others are held to.
        self.scale = torch.where(scale > 0, scale, scale[scale > 0].median() if bool((scale > 0).any()) else 1.0)
        """[N] pixels per world unit, in the nearest training camera."""
        self.moves = far * self.scale > STILL
        self.changes = (changed * self.scale > STILL) | (faded > 1 / 510)
        self.shown = strongest >= ALPHA_MIN


def _middles(times: Sequence[float]) -> list[float]:
    return [(a + b) / 2 for a, b in itertools.pairwise(times)]


def _choose_keys(times: Sequence[float], travel: _Travel, most: int) -> list[float]:
    """The first and the last time, then one after the other the time at which the straight lines are worst."""
    last, chosen = len(times) - 1, sorted({0, len(times) - 1})
    counts = (travel.shown & (travel.moves | travel.changes))[travel.sample]
    path = [torch.cat(state.select(travel.sample)[:2], 1)[counts] for state in travel.states]
    sizes = travel.scale[travel.sample][counts].float()
    errors = [0.0] * len(times)

    def measure(left: int, right: int) -> None:
        errors[left] = errors[right] = 0.0
        for i in range(left + 1, right):
            share = (times[i] - times[left]) / (times[right] - times[left])
            errors[i] = Offset.of(distance(torch.lerp(path[left], path[right], share), path[i]) * sizes).hundredth

    measure(0, last)
    while len(chosen) < most and max(errors) > GOOD:
        worst = errors.index(max(errors))
        place = int(np.searchsorted(chosen, worst))
        measure(chosen[place - 1], worst)
        measure(worst, chosen[place])
        chosen.insert(place, worst)
    return [times[i] for i in chosen]


def distance(a: Tensor, b: Tensor) -> Tensor:
    """How far centres and ends of axes are apart at most, [M], of columns position and factor [M, 9]."""
    return (a[:, :3] - b[:, :3]).norm(dim=-1) + (a[:, 3:] - b[:, 3:]).norm(dim=-1)


def _offset(keys: Keys, scene: ExportScene, times: Sequence[float], scale: Tensor) -> Offset:
    """The distance between `keys` and the model at `times`, of all Gaussians that keys have, largest over time."""
    if not times:
        return Offset(0.0, 0.0, 0.0)
    worst, state, sizes = torch.zeros(len(keys.rows)).double(), None, scale[keys.rows]
    for time in times:
        state = state_at(scene, time, state)
        true, baked = state.select(keys.rows), keys.at(time)
        off = distance(torch.cat(true[:2], 1), torch.cat(baked[:2], 1)) * sizes
        worst = torch.maximum(worst, torch.where(true.opacities >= ALPHA_MIN, off, 0))
    return Offset.of(worst)


def morton_order(positions: np.ndarray) -> np.ndarray:
    """An order of rows [N] in which neighbours in space stand beside each other (Morton's curve, 10 bits an axis)."""
    if not len(positions):
        return np.zeros(0, np.int64)
    low, high = np.quantile(positions, [0.005, 0.995], axis=0)
    cells = np.clip((positions - low) / np.maximum(high - low, 1e-30), 0, 1) * 1023
    key = np.zeros(len(positions), np.int64)
    for axis in range(3):
        cell = cells[:, axis].astype(np.int64)
        for bit in range(10):
            key |= ((cell >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")

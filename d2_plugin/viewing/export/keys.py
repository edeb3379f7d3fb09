"""A moving scene of any model at key times, straight in between, with how far off that is.

Nothing is known of the model but its Gaussians at an instant. Between two keys a Gaussian's centre, opacity and the
Cholesky factor L of its covariance L L^T go straight: a mixture of factors is the factor of a covariance, and unlike
rotations and scales it has no axes to confuse. A Gaussian that never leaves its first key has no keys.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from d2_plugin.recordings.selection import spread
from d2_plugin.viewing.export.ply import ALPHA_MIN
from d2_plugin.viewing.export.scene import ExportScene

STILL = 0.05
"""Pixels of a training image; what moves less counts as standing still."""
GOOD = 0.1
"""Pixels that one Gaussian in a hundred may be off between keys where there are so many instants."""
MOST_STATES = 6_000_000
"""Gaussians times instants that are evaluated and kept, 80 bytes each: of 300,000 Gaussians, 20 instants."""


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

    hundredth: float
    """Exceeded by one Gaussian in a hundred."""
    largest: float

    @classmethod
    def of(cls, pixels: Tensor) -> Offset:
        """Of distances [N] in pixels."""
        ordered = torch.cat([pixels.new_zeros(1), pixels]).sort().values
        return cls(float(ordered[min(int(0.99 * len(ordered)), len(ordered) - 1)]), float(ordered[-1]))

    def __str__(self) -> str:
        return f"99 % below {self.hundredth:.3f}, largest {self.largest:.2f} pixels"


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


def bake(scene: ExportScene) -> Keys:
    """The scene at key times, spread evenly over its frames and the middles between them: twice as many until the
    straight lines are good, or all."""
    frames, count = scene.seconds, len(scene.harmonics.coefficients)
    times = sorted({*frames, *((a + b) / 2 for a, b in itertools.pairwise(frames))})
    times = spread(times, min(max(MOST_STATES // max(count, 1), 12), len(times)))
    states = [state_at(scene, times[0])]
    for time in times[1:]:
        states.append(state_at(scene, time, states[-1]))
    first, scale = states[0], torch.zeros(count).double()
    far, changed, faded = (torch.zeros(count).double() for _ in range(3))
    for state in states:
        scale = torch.maximum(scale, scene.pixels_per_unit(state.positions))
        far = torch.maximum(far, (state.positions - first.positions).norm(dim=-1))
        changed = torch.maximum(changed, (state.factors - first.factors).norm(dim=-1))
        faded = torch.maximum(faded, (state.opacities - first.opacities).abs())
    # Outside every image a moving Gaussian is held to what the others are held to.
    scale = torch.where(scale > 0, scale, scale[scale > 0].median() if bool((scale > 0).any()) else 1.0)
    changes = (changed * scale > STILL) | (faded > 1 / 510)
    rank = torch.where(changes, 0, torch.where(far * scale > STILL, 1, 2))
    order = torch.from_numpy(morton_order(first.positions.numpy()))
    order = order[torch.stack([state.opacities for state in states]).amax(0)[order] >= ALPHA_MIN]
    rows = order[torch.sort(rank[order], stable=True).indices]
    changing, moving = int((rank[rows] == 0).sum()), int((rank[rows] < 2).sum())
    states = [state.select(rows) for state in states]
    keys, number = None, 2
    while keys is None or (keys.offset.hundredth > GOOD and number < len(times)):
        number = 2 if keys is None else min(2 * number - 1, len(times))
        chosen = spread(range(len(times)), number)
        kept = tuple(State(s.positions[:moving], s.factors[:changing], s.opacities[:changing]) for s in states)
        kept = tuple(kept[i] for i in chosen)
        keys = Keys(tuple(times[i] for i in chosen), states[0], rows, moving, changing, kept, Offset(0, 0))
        off = torch.zeros(len(rows)).double()
        for time, state in zip(times, states):
            baked = keys.at(time)
            apart = distance(torch.cat(state[:2], 1), torch.cat(baked[:2], 1)) * scale[rows]
            off = torch.maximum(off, torch.where(state.opacities >= ALPHA_MIN, apart, 0))
        keys = replace(keys, offset=Offset.of(off))
    return keys


def distance(a: Tensor, b: Tensor) -> Tensor:
    """How far centres and ends of axes are apart at most, [M], of columns position and factor [M, 9]."""
    return (a[:, :3] - b[:, :3]).norm(dim=-1) + (a[:, 3:] - b[:, 3:]).norm(dim=-1)


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

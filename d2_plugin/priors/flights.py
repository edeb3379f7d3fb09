"""What flies: the fast regions of all cameras that are one thing, and its way through the world.

A region is matched in each camera alone (`scene_flow`). Two cameras that see one thing place it at both instants where
their rays meet, without any depth; one camera alone does so by D*. Where the ways of most such things agree on one
acceleration, those that have it fall: all cameras then see one parabola, and a ball that one of them lost before a
person, or all of them at the end of its flight, is looked for where it must be (`d2_plugin.priors.between`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.geometry import projected
from d2_plugin.recordings.recording import Camera

NEAR = 0.35
"""Observations of one thing are seen within so much of its radius from where it is, and ..."""
NEAR_PIXELS = 1.5
"""... within so many pixels at least."""
AGREE = 0.35
"""Two accelerations agree that differ by less than this share of either."""
KNOWN = 0.3
"""Accelerations are known within so much of a thing's radius, at best."""
FEWEST_AGREEING = 8
"""Accelerations that must agree before anything falls, and at least three of ten."""


class Observation(NamedTuple):
    """A fast region of one camera in one interval."""

    camera: int
    region: int
    ends: np.ndarray  # [2, 2] its middle at both instants, (column, row)
    radius: float  # pixels
    depth: np.ndarray  # [2] of D* at both, nan where it is not known


@dataclass(eq=False)
class Passage:
    """A thing on its way from one instant to the next."""

    ends: np.ndarray  # [2, 3] world
    radius: float  # world
    observations: list[Observation] = field(default_factory=list)
    before: Passage | None = None
    after: Passage | None = None

    @property
    def over(self) -> np.ndarray:
        """How far it goes, [3]."""
        return np.asarray(self.ends[1] - self.ends[0])

    def accelerations(self) -> list[np.ndarray]:
        """Changes of displacement from interval to interval, [3] each."""
        changes = [] if self.before is None else [self.over - self.before.over]
        return changes if self.after is None else [*changes, self.after.over - self.over]

    def falls(self, change: np.ndarray, acceleration: np.ndarray) -> bool:
        """Whether a change of displacement is that acceleration, as far as it can be known of a thing of this size."""
        within = max(AGREE * float(np.linalg.norm(acceleration)), KNOWN * self.radius)
        return float(np.linalg.norm(change - acceleration)) < within

    def flies(self, acceleration: np.ndarray) -> bool:
        """Whether it, what it goes on from or what goes on from it falls as everything does that nothing holds."""
        return any(self.falls(change, acceleration) for passage in self._all() for change in passage.accelerations())

    def beyond(self, step: int, acceleration: np.ndarray) -> Passage:
        """Where it flies in the next interval, for a step of 1, or came from in the last one, for -1."""
        over = self.over + step * acceleration
        ends = [self.ends[1], self.ends[1] + over] if step > 0 else [self.ends[0] - over, self.ends[0]]
        return Passage(np.array(ends), self.radius)

    def bend(self, acceleration: np.ndarray) -> np.ndarray:
        """How far from the middle of the straight line it is halfway, [3], of something that flies.

        Where what came before and what comes after both contradict the acceleration, it hit something in between: both
        flights are continued into the interval, and the one that has fallen less far is where it is.
        """
        own = self.accelerations()
        if any(self.falls(change, acceleration) for change in own):
            return -acceleration / 8
        if self.before is None or self.after is None:
            return -own[0] / 8
        onwards = 0.5 * (self.before.over + acceleration) - acceleration / 8
        backwards = self.over - (0.5 * (self.after.over - acceleration) + acceleration / 8)
        halfway = onwards if onwards @ acceleration < backwards @ acceleration else backwards
        return np.asarray(halfway - self.over / 2)

    def _all(self) -> Iterator[Passage]:
        """All of its way: what came before it, last first, itself, and what comes after."""
        passage: Passage | None = self
        while passage is not None:
            yield passage
            passage = passage.before
        passage = self.after
        while passage is not None:
            yield passage
            passage = passage.after

    def where(self, part: float, acceleration: np.ndarray) -> np.ndarray:
        """Where it is when a part of the time has passed, [3]."""
        return self.ends[0] + part * self.over + 4 * part * (1 - part) * self.bend(acceleration)


def passages(cameras: Sequence[Camera], observations: Sequence[Observation]) -> list[Passage]:
    """The things that the observations of one interval show, those that most cameras see first."""
    pairs = (pair for pair in itertools.combinations(observations, 2) if pair[0].camera != pair[1].camera)
    alone = ([one] for one in observations if np.isfinite(one.depth).all())
    tried = [ends for some in itertools.chain(pairs, alone) if (ends := _placed(cameras, some)) is not None]
    if not tried:
        return []
    off = np.stack([_off(cameras[one.camera], one, np.array(tried)) for one in observations], axis=1)
    views, found = np.array([one.camera for one in observations]), []
    while np.isfinite(off).any():
        seeing = sum(np.isfinite(off[:, views == camera]).any(axis=1).astype(int) for camera in set(views))
        most = np.flatnonzero(seeing == seeing.max())
        best = min(most, key=lambda index: np.mean(off[index][np.isfinite(off[index])]))
        alike = np.flatnonzero(np.isfinite(off[best])).tolist()
        shown = [observations[index] for index in alike]
        again = _placed(cameras, shown) if seeing[best] > 1 else None
        ends = tried[best] if again is None else again
        sizes = [one.radius / pixels_across(cameras[one.camera], ends)[0] for one in shown]
        found.append(Passage(ends, float(np.median(sizes)), shown))
        off[:, alike] = np.inf
    return found


def _placed(cameras: Sequence[Camera], observations: Sequence[Observation]) -> np.ndarray | None:
    """The ends [2, 3] of the way of what observations of different cameras see, by D* where there is one alone."""
    if len(observations) == 1:
        return cameras[observations[0].camera].world(observations[0].ends, observations[0].depth)
    centres = np.array([cameras[one.camera].centre for one in observations])[:, None]
    rays = np.array([cameras[one.camera].world(one.ends, np.ones(2)) for one in observations]) - centres
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]  # what is left of a place beside a ray
    total = across.sum(axis=0)
    if np.linalg.cond(total).max() > 1e4:  # all but parallel
        return None
    return np.linalg.solve(total, (across @ centres[..., None]).sum(axis=0))[..., 0]


def _off(camera: Camera, observation: Observation, ends: np.ndarray) -> np.ndarray:
    """How far it is from where each of some ways [K, 2, 3] is seen, over what it may be; infinite beyond that."""
    pixels, depth, _ = projected(camera, ends.reshape(-1, 3))
    off = np.linalg.norm(pixels.reshape(-1, 2, 2) - observation.ends, axis=-1).max(axis=-1)
    off = off / max(NEAR_PIXELS, NEAR * observation.radius)
    return np.where((depth > 0).reshape(-1, 2).all(axis=-1) & (off <= 1), off, np.inf)


def pixels_across(camera: Camera, points: np.ndarray) -> np.ndarray:
    """How many pixels [K] one world unit takes at world points [K, 3]."""
    return np.asarray(camera.K[0, 0] / projected(camera, points)[1])


def link(intervals: Sequence[Sequence[Passage]]) -> None:
    """Say of each passage which one of the interval before it goes on from, and which one goes on from it."""
    for index, later in enumerate(intervals[1:]):
        pairs = [(float(np.linalg.norm(a.ends[1] - b.ends[0])), a, b) for a in intervals[index] for b in later]
        for distance, a, b in sorted(pairs, key=lambda pair: pair[0]):
            if distance < (a.radius + b.radius) / 2 and a.after is None and b.before is None:
                join(a, b)


def join(before: Passage, after: Passage) -> None:
    """The one goes on from the other."""
    before.after, after.before = after, before


def common_acceleration(intervals: Sequence[Sequence[Passage]]) -> np.ndarray | None:
    """The acceleration [3], world units per interval squared, that most passages share; None where they do not."""
    changes = [b.after.over - b.over for each in intervals for b in each if b.after is not None for _ in b.observations]
    seen = np.array(changes).reshape(-1, 3)
    if len(seen) < FEWEST_AGREEING:
        return None
    lengths = np.linalg.norm(seen, axis=1)
    # One by one: a long recording has thousands, whose pairs would fill the memory.
    each = (np.linalg.norm(seen - one, axis=1) < AGREE * length for one, length in zip(seen, lengths))
    agree = max(each, key=np.count_nonzero)
    enough = agree.sum() >= max(FEWEST_AGREEING, 0.3 * len(seen))
    return np.asarray(np.median(seen[agree], axis=0)) if enough else None

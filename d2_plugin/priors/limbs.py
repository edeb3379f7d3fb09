"""Limbs: what turns about a joint further than dense flow follows.

A forearm that swings is lost by flow (`scene_flow`), though the body that it hangs on is followed. It touches that at
its joint, which goes along with the flow there; so one number is sought, the angle. What is found from the earlier
instant counts only if the same is found from the later one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.scene_flow import FINE_WIDTH, LANDS_BESIDE, SMALLEST, Region, components, foreground, opened
from d2_plugin.recordings.images import opencv

SMALLEST_LIMB = 30
"""Pixels of a limb in an image of `FINE_WIDTH`."""
TOUCHING = 3
"""Pixels that it has in common with what flow follows, at least."""
TURNS = np.radians(np.arange(-75.0, 75.1, 7.5))
"""The angles that are tried. Two agree that are two steps apart."""
PER_RADIAN = 3.0
"""The smaller of two angles is taken that match as well: what is added to the root mean square difference."""
WORST, GAIN = 50.0, 6.0
"""Largest such difference, and how much smaller it must be than without a turn."""
LOST = 0.4
"""Share of where it lands that flow does not follow back."""
SAME = 0.4
"""Share of the smaller of two limbs that both have, if they are one."""


def limbs(
    images: Sequence[np.ndarray],
    still: np.ndarray,
    flows: Sequence[np.ndarray],
    follows: Sequence[np.ndarray],
    known: Sequence[Region],
) -> list[Region]:
    """The limbs between two instants that are found from each of them.

    Args:
        images: RGB [H, W, 3] uint8 of both instants.
        still: of the camera, see `scene_flow.still_image`.
        flows: dense flow [H, W, 2] from the earlier image to the later one, and back.
        follows: pixels [H, W] of both that these follow.
        known: regions that were matched.
    """
    fronts = [foreground(image, still) for image in images]
    lost = [front & ~follow for front, follow in zip(fronts, follows)]
    for region in known:
        lost[0].flat[region.start] = lost[1].flat[region.end] = False
    ends = [_Instant(*end) for end in zip(images, fronts, flows, follows, lost)]
    found, back = list(_turning(*ends)), [_reversed(region) for region in _turning(*ends[::-1])]
    pairs = [(one, other) for one in found for other in back if _same(one, other)]
    return [region for region in (*found, *back) if any(region in pair for pair in pairs)]


class _Instant(NamedTuple):
    image: np.ndarray  # [H, W, 3]
    front: np.ndarray  # [H, W] what differs from the still image
    flow: np.ndarray  # [H, W, 2] to the other instant
    follows: np.ndarray  # [H, W] where that does
    lost: np.ndarray  # [H, W] what is to be explained


def _turning(here: _Instant, there: _Instant) -> Iterator[Region]:
    """The limbs of one instant that turn to the other."""
    cv2, shape = opencv("scene flow"), here.front.shape
    least = SMALLEST_LIMB * max(1, round(shape[1] / FINE_WIDTH)) ** 2
    for piece in components(opened(here.lost), least):
        limb = (cv2.dilate(piece.view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & here.front
        touching = cv2.dilate(limb.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        touching &= here.front & here.follows & ~limb
        pixels, contact = (np.argwhere(mask)[:, ::-1] for mask in (limb, touching))
        if len(contact) < TOUCHING:
            continue
        joint, shift = contact.mean(axis=0), np.median(here.flow[touching], axis=0)
        length = np.linalg.norm(pixels - pixels.mean(axis=0), axis=1).max()
        if np.linalg.norm(contact - joint, axis=1).mean() > length:
            continue  # it is held all around
        reach = np.linalg.norm(pixels - joint, axis=1).max() + np.linalg.norm(shift) + 2
        low, high = np.maximum(joint - reach, 0).astype(int), (joint + reach + 1).astype(int)
        box = slice(low[1], high[1]), slice(low[0], high[0])
        small = here.image[box], limb[box], there.image[box], there.front[box]
        tried = [_turned(*small, joint - low, shift, turn) for turn in TURNS]
        costs = np.array([cost for cost, _ in tried])
        best = int(np.argmin(costs + PER_RADIAN * np.abs(TURNS)))
        landed = np.zeros(shape, bool)
        landed[box] = tried[best][1] & there.front[box]
        if costs[best] > WORST or costs[len(TURNS) // 2] - costs[best] < GAIN:
            continue
        if landed.sum() > SMALLEST and there.lost[landed].mean() > LOST:
            ends = np.flatnonzero(limb), np.flatnonzero(landed)
            yield Region(*ends, shift, float(costs[best]), shape, float(TURNS[best]), complex(*joint))


def _turned(
    image: np.ndarray,
    limb: np.ndarray,
    other: np.ndarray,
    front: np.ndarray,
    joint: np.ndarray,
    shift: np.ndarray,
    turn: float,
) -> tuple[float, np.ndarray]:
    """How unlike the other instant is where a limb lands, and where that is [H, W]."""
    cv2, size = opencv("scene flow"), limb.shape[::-1]
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moving = np.column_stack([matrix, joint + shift - matrix @ joint])
    there = cv2.warpAffine(image, moving, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    place = cv2.warpAffine(limb.view(np.uint8), moving, size, flags=cv2.INTER_NEAREST) > 0
    if place.sum() < 0.7 * limb.sum():  # much of it leaves the image
        return np.inf, place
    difference = there[place].astype(float) - other[place]
    return float(np.sqrt(np.mean(difference**2)) + LANDS_BESIDE * (1 - front[place].mean())), place


def _reversed(region: Region) -> Region:
    """The same way, found from the later instant, from the earlier one."""
    joint = region.joint + complex(*region.shift)
    return Region(region.end, region.start, -region.shift, region.cost, region.shape, -region.turn, joint)


def _same(one: Region, other: Region) -> bool:
    """Whether two limbs are one."""
    ends = ((one.start, other.start), (one.end, other.end))
    shared = [len(np.intersect1d(*pixels)) / min(map(len, pixels)) for pixels in ends]
    return abs(one.turn - other.turn) < 2.1 * (TURNS[1] - TURNS[0]) and min(shared) > SAME

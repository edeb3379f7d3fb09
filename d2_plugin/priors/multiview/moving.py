"""Whether maps of several views show what moves: where images change from instant to instant, their depth has to.

Maps of other instants, as of a wrong numbering, are right where nothing moves and wrong where it counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.scene_flow import foreground

MOVED = 0.1
"""Change of log depth against what stands still, above which a map shows that something moved."""
ITS_OWN = 1.3
"""Changes of images and of maps overlap more at the same instant than at two others, by this factor: 1.9 to 3.1
on studio, plaza and dome (EMULATED maps), 0.6 to 1.3 with maps in another order."""
IN_PLACE = 0.5
"""With more overlap than this of the images' changes at two instants, all moves in its place and nothing is told."""


class Instant(NamedTuple):
    """What the views show at one instant, or where nothing moves."""

    images: np.ndarray
    """[V, h, w, 3], of the maps' size."""
    depth: np.ndarray
    """Log of depth [V, h, w], NaN where it is not known, in the scale of the recording's first instant."""

    def changes(self, still: Instant) -> tuple[np.ndarray, np.ndarray]:
        """The pixels [V, h, w] at which the images, and the maps, differ from what stands still."""
        seen = np.stack([foreground(*views) for views in zip(self.images, still.images)])
        return seen, np.abs(self.depth - still.depth) > MOVED


def follow_images(seen: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> bool:
    """Whether changes `shown` by maps are those `seen` in images, bool [V, h, w] at some instants; True if unknown."""
    overlaps = np.array([[_overlap(one, other) for other in shown] for one in seen])
    own, others = np.diag(overlaps).mean(), overlaps[~np.eye(len(seen), dtype=bool)].mean()
    in_place = np.mean([_overlap(one, other) for one, other in itertools.combinations(seen, 2)])
    return bool(own >= ITS_OWN * others or in_place > IN_PLACE)


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))

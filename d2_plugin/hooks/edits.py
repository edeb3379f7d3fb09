"""What becomes of the hooks' edits: limits before the backbone makes them, its rows followed after, idle hooks."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from d2_plugin.protocol import Splats

_log = logging.getLogger(__name__)


def limited(mask: Tensor, share: float, step: int) -> Tensor:
    """The rows to remove, bool [N], or a share of all N spread evenly over them where more were asked for."""
    asked, most = int(mask.sum()), int(share * len(mask))
    if asked <= most:
        return mask
    message = "step %d: the hooks would remove %d of %d Gaussians, and at most %d go in one step (remove_at_most)"
    _log.warning(message, step, asked, len(mask), most)
    rows = torch.nonzero(mask).squeeze(1)
    chosen = torch.arange(most, device=mask.device) * len(rows) // max(most, 1)
    return torch.zeros_like(mask).index_fill(0, rows[chosen], True)


def faintest(fresh: Tensor, excess: int, slices: Iterable[Splats]) -> Tensor:
    """Of the rows `fresh` [N] (not 0 where the trainer has just added one) at most `excess` that are least opaque in
    any of the slices: bool [N], on the device of the slices."""
    brightest = torch.zeros(len(fresh))
    for splats in slices:
        brightest = brightest.to(splats.opacities)
        brightest[splats.rows] = torch.maximum(brightest[splats.rows], splats.opacities)
    fresh = fresh.to(brightest.device)
    order = torch.argsort(torch.where(fresh > 0, brightest, torch.inf), stable=True)
    chosen = order[: min(excess, int(fresh.count_nonzero()))]
    return torch.zeros_like(fresh, dtype=torch.bool).index_fill(0, chosen, True)


def followed(values: Tensor, index: Tensor, new: int) -> Tensor:
    """Per-row integers after a change: row r was row index[r] before, -1 for a new one, which gets `new`.

    Rows that nobody reported (a model resumed without our state) have 0.
    """
    count = max(len(values), int(index.max()) + 1 if len(index) else 0)
    before = torch.nn.functional.pad(values, (0, count - len(values)))
    return torch.where(index < 0, new, before[index.clamp(min=0)] if count else 0).int()


NEXT_TO_NOTHING = 1e-3
"""An evaluation that changes a smaller share of the Gaussians than this has changed next to nothing."""


class Idle:
    """Counts each hook's evaluations in a row that changed next to nothing, which cost surveys of several views."""

    def __init__(self, names: Iterable[str], after: int) -> None:
        """A hook retires after so many of them (0: never)."""
        self.after = after
        self.evaluations = dict.fromkeys(names, 0)
        self.retired: dict[str, int] = {}

    def retires(self, name: str, step: int, changes: int, gaussians: int, settling: int) -> bool:
        """Whether the hook retires with this evaluation; `settling` is how many at its start cannot change anything."""
        if not self.after:
            return False
        changed = changes >= max(NEXT_TO_NOTHING * gaussians, 1)
        self.evaluations[name] = 0 if changed else self.evaluations[name] + 1
        if self.evaluations[name] < self.after + settling:
            return False
        self.retired[name] = step
        return True

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a state with `idle` and `retired`."""
        self.evaluations, self.retired = dict(state["idle"]), dict(state["retired"])

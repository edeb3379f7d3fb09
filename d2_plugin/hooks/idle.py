"""Hooks that change next to nothing retire: their evaluations survey several views, and that takes time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


class Idle:
    """Counts each hook's evaluations in a row that changed next to nothing."""

    def __init__(self, names: Iterable[str], after: int, below: float) -> None:
        """A hook retires after so many of them (0: never); the share `below` of all Gaussians is next to nothing."""
        self.after, self.below = after, below
        self.evaluations = dict.fromkeys(names, 0)
        self.retired: dict[str, int] = {}

    def retires(self, name: str, step: int, changes: int, gaussians: int, settling: int) -> bool:
        """Whether the hook retires with this evaluation; `settling` is how many at its start cannot change anything."""
        if not self.after:
            return False
        changed = changes >= max(self.below * gaussians, 1)
        self.evaluations[name] = 0 if changed else self.evaluations[name] + 1
        if self.evaluations[name] < self.after + settling:
            return False
        self.retired[name] = step
        return True

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a state with `idle` and `retired`."""
        self.evaluations, self.retired = dict(state["idle"]), dict(state["retired"])

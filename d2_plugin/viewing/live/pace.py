"""How large a picture may be while something moves, and how much of a training's time may go into pictures."""

from __future__ import annotations

from dataclasses import dataclass

SMALLEST = 72
"""Height in pixels below which no picture is drawn, however slow."""
FIXED = 4e-3
"""Seconds of a picture that do not depend on its size, before any was drawn."""


@dataclass
class Resolution:
    """Learns what a pixel costs, so that a moving picture is as large as fits its time."""

    seconds_per_pixel: float = 1e-7

    def drew(self, pixels: int, seconds: float) -> None:
        """Note a picture; one odd measurement changes little."""
        found = seconds / max(pixels, 1)
        self.seconds_per_pixel += 0.25 * (found - self.seconds_per_pixel)

    def size(self, aspect: float, most: int, seconds: float | None = None) -> tuple[int, int]:
        """Width and height, at most `most` pixels high, that take about `seconds`; None is as large as allowed."""
        height = most
        if seconds is not None:
            height = int((max(seconds - FIXED, FIXED) / self.seconds_per_pixel / max(aspect, 1e-3)) ** 0.5)
        height = max(min(height, most), min(SMALLEST, most))
        return max(round(height * aspect), 1), height


@dataclass
class Share:
    """Lets work take a share of the time that passes; what was not used is kept for a moment only."""

    share: float
    spent: float = 0.0
    """Seconds that are still to be paid off."""
    kept: float = 0.5
    """Seconds of work that may be saved up."""

    def passes(self, seconds: float) -> None:
        """Time has passed."""
        self.spent = max(self.spent - self.share * seconds, -self.kept * self.share)

    def spend(self, seconds: float) -> None:
        """Work was done."""
        self.spent += seconds

    @property
    def due(self) -> bool:
        """Whether there is time for more."""
        return self.spent <= 0

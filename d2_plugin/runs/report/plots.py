"""What a plot is, before anything is drawn: axes with round ticks, and series of marks and lines in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
EDGE = 0.06
"""Room between the outermost marks and the frame, as a share of the axis."""


class Point(NamedTuple):
    """One mark: its place, what the tooltip says, and a label beside it where there is room."""

    x: float
    y: float
    note: str = ""
    label: str = ""
    faded: bool = False


@dataclass(frozen=True)
class Series:
    """Marks of one colour and shape; `line` joins some points, `hollow` marks are figures from elsewhere."""

    name: str
    points: tuple[Point, ...]
    line: tuple[tuple[float, float], ...] = ()
    color: int = 0
    hollow: bool = False


@dataclass(frozen=True)
class Axis:
    """A range of values with a label that names the unit."""

    label: str
    low: float
    high: float
    log: bool = False
    names: tuple[str, ...] = ()
    """An axis with names lists them, at 0, 1, ..."""

    @classmethod
    def listing(cls, label: str, names: Sequence[str]) -> Axis:
        """An axis of names, the first one at the top."""
        return cls(label, len(names) - 0.4, -0.6, names=tuple(names))

    @classmethod
    def around(cls, label: str, values: Iterable[float], log: bool = False) -> Axis:
        """The range of `values` with some room at both ends; a decade around a single one."""
        known = [value for value in values if math.isfinite(value) and (value > 0 or not log)] or [1.0]
        low, high = (math.log10(min(known)), math.log10(max(known))) if log else (min(known), max(known))
        if high - low < 1e-9 * max(abs(high), 1e-12) or (log and high - low < 0.3):
            room = 0.5 if log else max(0.1 * abs(high), 1e-6)
        else:
            room = EDGE * (high - low)
        ends = (low - room, high + room)
        return cls(label, *((10 ** ends[0], 10 ** ends[1]) if log else ends), log)

    def place(self, value: float) -> float:
        """0 at `low`, 1 at `high`."""
        if self.log:
            return math.log(max(value, 1e-300) / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self, most: int = 7) -> list[tuple[float, str]]:
        """Round values within the range, with their text."""
        if self.names:
            return list(enumerate(self.names))
        values = self._decades(most) if self.log else self._steps(most)
        return [(value, number(value)) for value in values if self.low <= value <= self.high]

    def _decades(self, most: int) -> list[float]:
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
        if last - first >= 2:
            return [10.0**power for power in range(first, last + 1, math.ceil((last - first + 1) / most))]
        factors = (1, 2, 5) if self.high / self.low > 3 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
        return [factor * 10.0**power for power in range(first - 1, last + 1) for factor in factors]

    def _steps(self, most: int) -> list[float]:
        raw = (self.high - self.low) / most
        unit = 10 ** math.floor(math.log10(raw))
        step = next(factor * unit for factor in (1, 2, 5, 10) if factor * unit >= raw)
        return [step * i for i in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


@dataclass(frozen=True)
class Plot:
    """Axes with series in them."""

    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]


def number(value: float) -> str:
    """A short text: plain where that is short, powers of ten otherwise."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.6g}"
    power = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**power
    front = "" if abs(mantissa - 1) < 1e-6 else f"{mantissa:.3g}·"
    return f"{front}10{str(power).translate(SUPERSCRIPTS)}"

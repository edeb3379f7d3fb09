"""How a cost grows with a size: the exponent of the power that fits best."""

from __future__ import annotations

import math
from collections.abc import Sequence


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope p of cost ~ size^p by least squares in logarithms, from (size, cost); None with fewer than two sizes."""
    if len({size for size, _ in points}) < 2:
        return None
    logs = [(math.log(size), math.log(value)) for size, value in points]
    mean_x, mean_y = (sum(values) / len(logs) for values in zip(*logs))
    spread = sum((x - mean_x) ** 2 for x, _ in logs)
    return sum((x - mean_x) * (y - mean_y) for x, y in logs) / spread


def power(points: Sequence[tuple[float, float]], of: str) -> str | None:
    """The exponent as text, such as `frames^0.62`; None with fewer than two sizes."""
    found = exponent(points)
    return None if found is None else f"{of}^{round(found, 2) + 0.0:.2f}"

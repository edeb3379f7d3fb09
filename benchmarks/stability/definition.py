"""What a sweep is: one parameter, how far it is driven, what is measured, and what guards it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

Measure = Callable[[float, torch.dtype], float]
"""The error at one value of the parameter, computed in that precision; not finite where the result is not."""

USUAL = {"float32": 1e-4, "float64": 1e-9}
"""Limits of most sweeps."""


@dataclass(frozen=True)
class Sweep:
    """One parameter and how far it is driven."""

    name: str
    parameter: str
    """What is swept, with its unit."""
    values: tuple[float, ...]
    error: str
    """What the error is."""
    guard: str
    """What keeps this finite, or that nothing does."""
    limits: Mapping[str, float]
    """Largest error that counts as ok, per precision; a precision without one is not measured."""
    measure: Measure


def sweep(
    parameter: str, values: tuple[float, ...], error: str, guard: str, limits: Mapping[str, float] = USUAL
) -> Callable[[Measure], Sweep]:
    """Make a sweep of the function that measures it, with that function's name."""

    def made(measure: Measure) -> Sweep:
        name = getattr(measure, "__name__", "").replace("_", " ")
        return Sweep(name, parameter, values, error, guard, limits, measure)

    return made


def decades(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Powers of ten from 10^first to 10^last."""
    return tuple(10.0**power for power in range(first, last + 1, step))

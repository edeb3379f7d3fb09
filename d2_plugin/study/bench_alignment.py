"""`d2 bench alignment`: error against run time of the positive-scale Charbonnier fit, beside what else solves it.

All solvers get the same anchors, already normalised by median and mean deviation (none of the peers survives an offset
of 1e8 otherwise). The error is F / F* - 1 with F evaluated in float64 and F* the least value that any of them reached.
"""

from __future__ import annotations

import argparse
import logging
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import torch

from d2_plugin.priors.affine import charbonnier, fit_affine

from .rows import Row, append_rows, make_row

logger = logging.getLogger(__name__)

OUTLIERS = (0.0, 0.2, 0.4)
EPSILON = 0.01
TOLERANCES = (1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
STEPS = (1, 3, 10, 30, 100)

Line = tuple[float, float]
"""Scale and shift."""


class Anchors(NamedTuple):
    """A map x [n] and what it is aligned to, y [n], float64."""

    x: np.ndarray
    y: np.ndarray

    def objective(self, line: Line) -> float:
        """F of the paper, summed over all anchors."""
        return float(charbonnier(line[0] * self.x + line[1] - self.y, EPSILON).sum())


def anchors(count: int, outliers: float, seed: int = 0) -> Anchors:
    """A line with noise of 1 % and uniform outliers, in units of median and mean deviation."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(1, 6, count)
    x = (y - 0.5) / 2 + rng.normal(0, 0.005, count)
    wrong = rng.choice(count, int(outliers * count), replace=False)
    y[wrong] = rng.uniform(0.5, 12, len(wrong))
    return Anchors(*((part - np.median(part)) / np.abs(part - np.median(part)).mean() for part in (x, y)))


def newton(data: Anchors, tolerance: float) -> Line:
    """This package: stops at a certified relative duality gap of `tolerance`."""
    fit = fit_affine(*data, epsilon=EPSILON, tolerance=tolerance)
    return fit.scale, fit.shift


def reweighted(data: Anchors, steps: int, dtype: type = np.float64) -> Line:
    """Iteratively reweighted least squares; one step is plain least squares."""
    x, y = (part.astype(dtype) for part in data)
    weights = np.ones_like(x)
    scale = shift = dtype(0)
    for _ in range(steps):
        mean_x, mean_y = np.average(x, weights=weights), np.average(y, weights=weights)
        scale = max((weights * (x - mean_x) * (y - mean_y)).sum() / (weights * (x - mean_x) ** 2).sum(), dtype(0))
        shift = mean_y - scale * mean_x
        weights = 1 / np.sqrt((scale * x + shift - y) ** 2 + dtype(EPSILON**2))
    return float(scale), float(shift)


def lbfgs(data: Anchors, steps: int) -> Line:
    """torch's L-BFGS with a strong Wolfe search, the outsider that knows nothing of the problem."""
    x, y = (torch.from_numpy(part) for part in data)
    line = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS(
        [line], max_iter=steps, tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe"
    )

    def closure() -> torch.Tensor:
        solver.zero_grad()
        loss = torch.hypot(line[0] * x + line[1] - y, x.new_tensor(EPSILON)).sum()
        loss.backward()
        return loss

    solver.step(closure)
    return tuple(line.tolist())


def solvers() -> dict[tuple[str, str], Callable[[Anchors], Line]]:
    """What is compared, by method and setting."""
    found: dict[tuple[str, str], Callable[[Anchors], Line]] = {}
    for tolerance in TOLERANCES:
        found["d2", f"gap {tolerance:.0e}"] = lambda data, at=tolerance: newton(data, at)
    found["least squares", "default"] = lambda data: reweighted(data, 1)
    for steps in STEPS[1:]:
        found["IRLS", f"{steps} steps"] = lambda data, at=steps: reweighted(data, at)
        found["IRLS float32", f"{steps} steps"] = lambda data, at=steps: reweighted(data, at, np.float32)
        found["L-BFGS", f"{steps} steps"] = lambda data, at=steps: lbfgs(data, at)
    return found


def bench_alignment(
    counts: Sequence[int] = (20_000,), outliers: Sequence[float] = OUTLIERS, repeats: int = 5, command: str = ""
) -> list[Row]:
    """One row per solver, setting and case; times are medians over `repeats` after one call that is not counted."""
    return [
        row for count in counts for share in outliers for row in _case(anchors(count, share), share, repeats, command)
    ]


def _case(data: Anchors, outliers: float, repeats: int, command: str) -> list[Row]:
    lines, seconds = {}, {}
    for name, solve in solvers().items():
        lines[name] = solve(data)
        seconds[name] = median(_seconds(solve, data) for _ in range(max(repeats, 1)))
    values = {name: data.objective(line) for name, line in lines.items()}
    best = min(values, key=lambda name: values[name])
    case = f"{len(data.x)} anchors, {outliers:.0%} outliers"
    logger.info("%s is measured", case)
    return [
        make_row(
            *("alignment", case, *name),
            error=value / values[best] - 1,
            seconds=seconds[name],
            command=command,
            scale_error=abs(lines[name][0] / lines[best][0] - 1),
            outliers=outliers,
            anchors=len(data.x),
            repeats=repeats,
        )
        for name, value in values.items()
    ]


def _seconds(solve: Callable[[Anchors], Line], data: Anchors) -> float:
    start = time.perf_counter()
    solve(data)
    return time.perf_counter() - start


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `d2 bench alignment`."""
    parser = argparse.ArgumentParser(prog="d2 bench alignment", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs.jsonl"), help="rows are added to it; runs.jsonl")
    parser.add_argument("--anchors", nargs="+", type=int, default=[20_000], help="pixels with both depths; 20000")
    parser.add_argument("--repeats", type=int, default=5, help="calls per row, the time is their median; 5")
    options = parser.parse_args(arguments)
    command = shlex.join(["d2", "bench", "alignment", *(arguments or ())])
    append_rows(options.output, bench_alignment(options.anchors, repeats=options.repeats, command=command))
    logger.info("rows are in %s", options.output)
    return 0

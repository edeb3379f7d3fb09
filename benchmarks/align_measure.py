"""What is measured about alignment: problems whose line is known, the methods that look for it, and their errors.

Each problem has anchors like a real one: depths of a room, a monocular value that is their line up to a few per cent
of noise, and wrong geometric depths, which are those of other places in the room. Least squares, Huber's weights,
RANSAC and the median rule of Inria's `make_depth_scale.py` are what other code bases align with.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.monocular.affine import AffineFit, fit_affine
from d2_plugin.priors.monocular.align import align
from d2_plugin.priors.settings import AlignSettings
from d2_plugin.recordings.recording import MonoKind

ROOM = (2.0, 8.0)
"""Nearest and farthest depth, world units; depths are uniform in their logarithm."""

MONO_NOISE = 0.02
"""Standard deviation of the monocular value about its line, as a share of depth or inverse depth."""

GEOMETRIC_NOISE = 0.002
"""Standard deviation of right geometric depths, as a share."""

TRUE_LINE = (0.35, 0.05)
"""Scale and shift from monocular value to depth or inverse depth."""

HUBER = 0.02
"""Relative residual above which Huber's weights fall; RANSAC counts inliers up to twice that."""

PROBES = 2000
"""Anchors among which RANSAC counts inliers."""

EXACT = 1e-13
"""Relative duality gap to which the reference optimum is solved."""

Line = tuple[float, float]
"""Scale and shift."""


@dataclass(frozen=True, eq=False)
class AlignProblem:
    """Anchors of one view, and the truth they were made from."""

    kind: MonoKind
    mono: np.ndarray  # [N] what the network says
    geometric: np.ndarray  # [N] D^g, of which a share is wrong
    clean_mono: np.ndarray  # [N] without noise: TRUE_LINE takes it to the truth exactly
    truth: np.ndarray  # [N] depth

    @property
    def target(self) -> np.ndarray:
        """What the line runs to: 1 / D^g for a relative map, D^g for a metric one."""
        return 1 / self.geometric if self.kind == "relative" else self.geometric

    def depth_error(self, line: Line) -> np.ndarray:
        """Relative error [N] of aligned depth that is due to the line alone; 1 where it gives no depth."""
        value = line[0] * self.clean_mono + line[1]
        if self.kind == "relative":
            value = np.where(value > 0, 1 / np.where(value > 0, value, 1), np.inf)
        return np.minimum(np.abs(value - self.truth) / self.truth, 1.0)

    def objective(self, line: Line, residual: str) -> float:
        """F of a line: the Charbonnier penalties of the relative or absolute residuals, as `align` sums them."""
        weights, epsilon = weights_and_epsilon(self.target, residual)
        return float(charbonnier(weights * (line[0] * self.mono + line[1] - self.target), epsilon).sum())


def charbonnier(residual: np.ndarray, epsilon: float) -> np.ndarray:
    """rho(r) = sqrt(r^2 + eps^2) - eps, in a form that neither cancels at small residuals nor overflows."""
    return residual * (residual / (np.hypot(residual, epsilon) + epsilon))


def align_problem(kind: MonoKind, anchors: int, outliers: float, seed: int = 0) -> AlignProblem:
    """A problem of `anchors` points; the share `outliers` has the geometric depth of another place in the room."""
    rng = np.random.default_rng([seed, anchors, round(100 * outliers)])
    truth, elsewhere = np.exp(rng.uniform(float(np.log(ROOM[0])), float(np.log(ROOM[1])), (2, anchors)))
    target = 1 / truth if kind == "relative" else truth
    clean = (target - TRUE_LINE[1]) / TRUE_LINE[0]
    mono = (target * (1 + rng.normal(0, MONO_NOISE, anchors)) - TRUE_LINE[1]) / TRUE_LINE[0]
    geometric = truth * (1 + rng.normal(0, GEOMETRIC_NOISE, anchors))
    wrong = rng.permutation(anchors)[: round(outliers * anchors)]
    geometric[wrong] = elsewhere[wrong]
    return AlignProblem(kind, mono, geometric, clean, truth)


def weights_and_epsilon(target: np.ndarray, residual: str) -> tuple[np.ndarray, float]:
    """What `align` makes of its default settings: the weights of the residuals and the smoothing."""
    epsilon = AlignSettings().epsilon
    if residual == "relative":
        return 1 / target, epsilon
    return np.ones_like(target), epsilon * float(np.median(target))


@dataclass(frozen=True)
class AlignMethod:
    """One way to find the line. `residual` is what it minimises, and what its objective gap is measured in."""

    name: str
    setting: str
    residual: str
    fit: Callable[[AlignProblem], Line]


def methods() -> list[AlignMethod]:
    """Ours at several tolerances, and the others."""
    found = [
        AlignMethod("certified", f"{residual}, gap {tolerance:g}", residual, partial(_line, residual, tolerance))
        for residual in ("relative", "absolute")
        for tolerance in (1e-2, 1e-6, 1e-10)
    ]
    found.append(AlignMethod("align()", "as the priors use it", "relative", _as_used))
    found += [AlignMethod("Huber IRLS", f"{count} iterations", "relative", partial(_huber, count)) for count in (5, 50)]
    found += [AlignMethod("RANSAC", f"{count} pairs", "relative", partial(_ransac, count)) for count in (50, 500)]
    found.append(AlignMethod("least squares", "closed form", "relative", partial(_huber, 0)))
    found.append(AlignMethod("median and MAD", "make_depth_scale.py", "relative", _median_and_mad))
    return found


def _certified(residual: str, tolerance: float, problem: AlignProblem) -> AffineFit:
    target = problem.target
    weights, epsilon = weights_and_epsilon(target, residual)
    return fit_affine(problem.mono, target, weights, epsilon=epsilon, tolerance=tolerance)


def _line(residual: str, tolerance: float, problem: AlignProblem) -> Line:
    found = _certified(residual, tolerance, problem)
    return found.scale, found.shift


def _as_used(problem: AlignProblem) -> Line:
    """Everything that building a prior does: selection, subsampling, fit, certificate, acceptance."""
    found = align(problem.mono[None], problem.geometric[None], kind=problem.kind, settings=AlignSettings())
    if not found.accepted:
        raise D2Error(found.status.value)
    return found.scale, found.shift


def _weighted(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> Line:
    """Weighted least squares in closed form, about the weighted mean: no digits are lost to the offset."""
    total = weights.sum()
    mean_x, mean_y = weights @ x / total, weights @ y / total
    scale = float(weights @ ((x - mean_x) * (y - mean_y)) / (weights @ (x - mean_x) ** 2))
    return scale, float(mean_y - scale * mean_x)


def _huber(iterations: int, problem: AlignProblem) -> Line:
    """Least squares of the relative residual, then so many times again with Huber's weights."""
    x, y = problem.mono, problem.target
    line = _weighted(x, y, y**-2)
    for _ in range(iterations):
        residual = np.abs(line[0] * x + line[1] - y) / y
        line = _weighted(x, y, np.minimum(1, HUBER / np.maximum(residual, 1e-300)) * y**-2)
    return line


def _ransac(pairs: int, problem: AlignProblem) -> Line:
    """The line through two anchors with most inliers among `PROBES` anchors, then least squares over all inliers."""
    x, y = problem.mono, problem.target
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, x.size, (2, pairs))
    apart = x[first] != x[second]
    first, second = first[apart], second[apart]
    scales = (y[first] - y[second]) / (x[first] - x[second])
    shifts = y[first] - scales * x[first]
    probe = rng.integers(0, x.size, min(x.size, PROBES))
    residual = np.abs(scales[:, None] * x[probe] + shifts[:, None] - y[probe]) / y[probe]
    best = (residual < 2 * HUBER).sum(axis=1).argmax()
    inliers = np.abs(scales[best] * x + shifts[best] - y) < 2 * HUBER * y
    return _weighted(x, y, np.where(inliers, y**-2, 0)) if inliers.sum() > 2 else (scales[best], shifts[best])


def _median_and_mad(problem: AlignProblem) -> Line:
    """Scale from mean absolute deviations about the median, shift from the medians (Inria, `make_depth_scale.py`)."""
    x, y = problem.mono, problem.target
    median_x, median_y = np.median(x), np.median(y)
    scale = float(np.abs(y - median_y).mean() / np.abs(x - median_x).mean())
    return scale, float(median_y - scale * median_x)


class AlignScore(NamedTuple):
    """Errors of one method on one case, medians over the seeds."""

    error: float  # F / F* - 1 in the method's own objective
    depth_error: float  # median over the view of the relative depth error due to the line
    seconds: float  # median wall time of one fit


def measure(method: AlignMethod, problems: list[AlignProblem], budget: float = 0.03) -> AlignScore:
    """Fit every problem, each again until `budget` seconds are spent on it or 20 times.

    Raises:
        D2Error: the method refuses a problem, in its own words.
    """
    gaps, errors, times = [], [], []
    for problem in problems:
        line, spent = _timed(method, problem, budget)
        times += spent
        best = optimum(problem, method.residual)
        gaps.append(max(problem.objective(line, method.residual) / best - 1, 0.0))
        errors.append(float(np.median(problem.depth_error(line))))
    return AlignScore(median(gaps), median(errors), median(times))


def _timed(method: AlignMethod, problem: AlignProblem, budget: float) -> tuple[Line, list[float]]:
    spent: list[float] = []
    while not spent or (sum(spent) < budget and len(spent) < 20):
        start = time.perf_counter()
        line = method.fit(problem)
        spent.append(time.perf_counter() - start)
    return line, spent


def optimum(problem: AlignProblem, residual: str) -> float:
    """F*, from the certified solver at a gap of `EXACT`, less what that gap leaves open."""
    found = _certified(residual, EXACT, problem)
    return problem.objective((found.scale, found.shift), residual) * (1 - found.gap)

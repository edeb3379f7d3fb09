"""The positive-scale Charbonnier fit, solved to a certified duality gap.

    minimise over a >= 0, b:   F(a, b) = sum_i rho(w_i (a x_i + b - y_i)),   rho(r) = sqrt(r^2 + eps^2) - eps

(paper, section "Dual-source Depth Consistency Prior Construction"). F is convex and smooth, so the optimum is unique
unless x is constant. The paper's a > 0 is an open set; the closed problem a >= 0 is solved, and an optimum on the
boundary says that no positive scale is best.

The certificate holds for any iterate. rho(r) = max over |u| <= 1 of u r - eps (1 - sqrt(1 - u^2)), hence for every u
with |u_i| <= 1, sum w_i u_i = 0 and s = sum w_i x_i u_i >= 0

    F* >= - sum u_i w_i y_i - eps sum (1 - sqrt(1 - u_i^2)),

and u = rho'(r), projected onto the equalities, makes this bound tight at the optimum.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BLENDS = (0.0, 0.01, 0.1, 0.5, 1.0)
"""Shares of IRLS curvature tried in turn; at 1 the model majorises F, so a step of it always descends."""

ARMIJO = 1e-4
MIN_EPSILON = 1e-100  # in normalised units: its square must not vanish
OBJECTIVE_FLOOR = 1e-6  # of eps per point: below it an objective is zero to all purposes
SINGULAR = 1e-14  # determinant of the 2x2 system, relative to the product of its diagonal


@dataclass(frozen=True)
class AffineFit:
    """y ~ scale x + shift with its certificate.

    `objective` is F and `gap` an upper bound of F - F*, relative to max(F, 1e-6 n eps): below a millionth of the
    smoothing per point an objective is zero to all purposes. `boundary` is True where scale = 0, `flat` where x is
    constant (then only the shift was fitted). `scale_error` is the sandwich standard error of the scale.
    """

    scale: float
    shift: float
    objective: float
    gap: float
    iterations: int
    count: int
    boundary: bool
    flat: bool
    scale_error: float


def fit_affine(
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    epsilon: float,
    tolerance: float = 1e-10,
    max_iterations: int = 100,
) -> AffineFit:
    """Fit scale >= 0 and shift; non-finite points and those without positive weight are ignored.

    Args:
        x: [n] what is aligned (a monocular prediction).
        weights: [n] multiplies each residual; 1 where None.
        epsilon: smoothing of rho, in units of weights * y; must be positive.
        tolerance: relative duality gap to stop at.
        max_iterations: Newton steps at most; the certificate tells what was reached.

    Returns:
        The fit; with no usable point everything is NaN and `count` is 0.
    """
    x, y, weights = _usable(x, y, weights)
    if x.size == 0:
        return AffineFit(np.nan, np.nan, np.nan, np.nan, 0, 0, boundary=False, flat=True, scale_error=np.nan)
    # Centre and spread: in these units an offset of 1e8 or a scale of 1e-3..1e6 changes nothing.
    weight, x_centre, y_centre = float(np.median(weights)), float(np.median(x)), float(np.median(y))
    weights, tiny = weights / weight, np.finfo(float).tiny
    x_spread = max(float(np.abs(x - x_centre).mean()), tiny)
    y_spread = max(float(np.abs(y - y_centre).mean()), epsilon / weight, tiny)
    problem = _Problem(
        p=weights * (x - x_centre) / x_spread,
        q=weights,
        t=weights * (y - y_centre) / y_spread,
        epsilon=max(epsilon / weight / y_spread, MIN_EPSILON),
    )
    flat = x.size < 2 or not x_spread > 64 * np.finfo(float).eps * np.abs(x).max()
    if flat:
        problem = _Problem(np.zeros_like(problem.p), problem.q, problem.t, problem.epsilon)
        shift = problem.best_shift(0.0, problem.median_shift())
        state = _State(0.0, shift, problem.sums(0.0, shift), 0.0, 0)
        boundary = False
    else:
        state = problem.solve(tolerance, max_iterations)
        boundary = state.a <= 0
    scale = state.a * y_spread / x_spread
    return AffineFit(
        scale=scale,
        shift=state.b * y_spread + y_centre - scale * x_centre,
        objective=state.sums.value * y_spread * weight,
        gap=state.gap,
        iterations=state.iterations,
        count=x.size,
        boundary=boundary,
        flat=flat,
        scale_error=_scale_error(state.sums) * y_spread / x_spread,
    )


def _usable(x: np.ndarray, y: np.ndarray, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.asarray(x, np.float64).ravel(), np.asarray(y, np.float64).ravel()
    weights = np.ones_like(x) if weights is None else np.asarray(weights, np.float64).ravel()
    keep = np.isfinite(x) & np.isfinite(y) & np.isfinite(weights) & (weights > 0)
    return (x, y, weights) if keep.all() else (x[keep], y[keep], weights[keep])


Step = tuple[float, float]
"""Along a and along b."""
Normal = tuple[float, float, float]
"""A 2x2 matrix sum c (p, q)(p, q)^T as its entries aa, ab, bb."""


class Sums(NamedTuple):
    """What one pass over the points gives at some a and b, with r the residual and u = rho'(r)."""

    value: float
    """sum rho(r)."""
    slope: Step
    """Its gradient."""
    irls: Normal
    """c = 1 / sqrt(r^2 + eps^2)."""
    newton: Normal
    """c = rho''(r)."""
    room: Normal
    """c = 1 - u^2."""
    spread: Normal
    """c = u^2."""


class _State(NamedTuple):
    a: float
    b: float
    sums: Sums
    gap: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _Problem:
    """min over a >= 0, b of sum rho(a p + b q - t): the same problem in normalised units.

    `p`, `q`, `t` are float64 [n].
    """

    p: np.ndarray
    q: np.ndarray
    t: np.ndarray
    epsilon: float

    def residual(self, a: float, b: float) -> np.ndarray:
        return a * self.p + b * self.q - self.t

    def root(self, r: np.ndarray) -> np.ndarray:
        """sqrt(r^2 + eps^2); in normalised units |r| <= n, so that the squares need no care."""
        return np.sqrt(r * r + self.epsilon * self.epsilon)

    def sums(self, a: float, b: float) -> Sums:
        r = self.residual(a, b)
        inverse_root = 1 / self.root(r)
        u, sharp = r * inverse_root, self.epsilon * inverse_root
        curvatures = inverse_root, inverse_root * sharp**2, 1 - u * u, u * u
        slope = dot(self.p, u), dot(self.q, u)
        return Sums(dot(r, u / (1 + sharp)), slope, *(self.normal(curvature) for curvature in curvatures))

    def normal(self, curvature: np.ndarray) -> Normal:
        cp = curvature * self.p
        return dot(cp, self.p), dot(cp, self.q), dot(curvature * self.q, self.q)

    @functools.cached_property
    def plain(self) -> Normal:
        """c = 1."""
        return dot(self.p, self.p), dot(self.p, self.q), dot(self.q, self.q)

    def median_shift(self) -> float:
        return float(np.median(self.t / self.q))

    def solve(self, tolerance: float, max_iterations: int) -> _State:
        """Newton with IRLS blending from a few IRLS steps; the gap uses the best bound over all iterates."""
        a, b = self._start()
        here = self.sums(a, b)
        bound, gap = -np.inf, np.inf
        floor = OBJECTIVE_FLOOR * self.t.size * self.epsilon
        for iteration in range(max_iterations + 1):
            bound = max(bound, self.lower_bound(a, b, here))
            gap = max(here.value - bound, 0.0) / max(here.value, floor)
            if gap <= tolerance or iteration == max_iterations:
                break
            step = self._descend(a, b, here)
            if step is None:
                break
            a, b, here = step
        return _State(a, b, here, gap, iteration)

    def _start(self) -> tuple[float, float]:
        """Least squares, then two reweighted steps."""
        least = _solve_2x2(*self.plain, dot(self.p, self.t), dot(self.q, self.t))
        if least is None:
            return 0.0, self.median_shift()
        a = max(0.0, least[0])
        b = dot(self.q, self.t - a * self.p) / self.plain[2]
        for _ in range(2):
            here = self.sums(a, b)
            step = _solve_2x2(*here.irls, -here.slope[0], -here.slope[1])
            if step is None:
                break
            moved = max(0.0, a + step[0]) - a
            a, b = a + moved, b - (here.slope[1] + here.irls[1] * moved) / here.irls[2]
        return a, b

    def _descend(self, a: float, b: float, here: Sums) -> tuple[float, float, Sums] | None:
        """One step that lowers F, on the boundary the exact best shift, or None where neither moves."""
        gradient_a, gradient_b = here.slope
        for blend in BLENDS:
            h_aa, h_ab, h_bb = ((1 - blend) * n + blend * i for n, i in zip(here.newton, here.irls))
            step = _solve_2x2(h_aa, h_ab, h_bb, -gradient_a, -gradient_b)
            if step is None:
                continue
            a_new, b_new = a + step[0], b + step[1]
            if a_new <= 0:
                a_new = 0.0
                b_new = b - (gradient_b + h_ab * (a_new - a)) / h_bb
            predicted = gradient_a * (a_new - a) + gradient_b * (b_new - b)
            there = self.sums(a_new, b_new)
            if there.value < here.value + ARMIJO * min(predicted, 0.0):
                return a_new, b_new, there
        b_new = self.best_shift(a, b) if a <= 0 else b
        return None if b_new == b else (a, b_new, self.sums(a, b_new))

    def best_shift(self, a: float, b: float) -> float:
        """argmin over b at fixed a: Newton on a monotone derivative inside a shrinking bracket, to the last digit."""
        zeros = (self.t - a * self.p) / self.q
        low, high = float(zeros.min()), float(zeros.max())
        b = min(max(b, low), high)
        for _ in range(200):
            r = self.residual(a, b)
            inverse_root = 1 / self.root(r)
            slope = dot(self.q, r * inverse_root)
            curvature = dot(self.q * self.q, inverse_root * (self.epsilon * inverse_root) ** 2)
            low, high = (low, b) if slope > 0 else (b, high)
            proposal = b - slope / curvature if curvature > 0 else np.nan
            b_new = proposal if low <= proposal <= high else 0.5 * (low + high)
            if abs(b_new - b) <= 1e-15 * max(1.0, abs(b)):
                return b_new
            b = b_new
        return b

    def lower_bound(self, a: float, b: float, here: Sums) -> float:
        """The dual value of u = rho'(r) after making it feasible; valid for every feasible a and b."""
        keep = max(0.0, here.slope[0]) if a <= 0 else 0.0
        r = self.residual(a, b)
        u = r * (1 / self.root(r))
        best = -np.inf
        # Moving only those u that have room to +-1 wastes least; where none has, all of them move and are scaled.
        for room, normal in ((1 - u * u, here.room), (np.ones_like(u), self.plain)):
            moved = u
            for _ in range(2):  # once more for what rounding leaves where the matrix is nearly singular
                left = dot(self.p, moved) - keep, dot(self.q, moved)
                step = _solve_2x2(*normal, *left) or (None if any(left) else (0.0, 0.0))
                if step is None:
                    break
                moved = moved - room * (step[0] * self.p + step[1] * self.q)
            else:
                feasible = moved / max(1.0, float(np.abs(moved).max()))
                square = np.minimum(feasible * feasible, 1.0)
                conjugate = float((square / (1 + np.sqrt(1 - square))).sum())
                best = max(best, -dot(feasible, self.t) - self.epsilon * conjugate)
        return best


def _scale_error(sums: Sums) -> float:
    """Sandwich standard error of the scale of an M-estimator: H^-1 (sum psi^2 z z^T) H^-1 with z = (p, q)."""
    row = _solve_2x2(*sums.newton, 1.0, 0.0)
    if row is None:
        return float("inf")
    m_aa, m_ab, m_bb = sums.spread
    return float(np.sqrt(max(row[0] ** 2 * m_aa + 2 * row[0] * row[1] * m_ab + row[1] ** 2 * m_bb, 0.0)))


def _solve_2x2(h_aa: float, h_ab: float, h_bb: float, g_a: float, g_b: float) -> tuple[float, float] | None:
    """Solution of the symmetric system, or None where it is singular to working precision."""
    determinant = h_aa * h_bb - h_ab * h_ab
    if not determinant > SINGULAR * h_aa * h_bb:
        return None
    return (h_bb * g_a - h_ab * g_b) / determinant, (h_aa * g_b - h_ab * g_a) / determinant


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Inner product on one core: BLAS splits vectors of this length over threads that wait for each other."""
    return float(np.einsum("i,i->", a, b))

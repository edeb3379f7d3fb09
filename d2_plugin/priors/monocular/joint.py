"""The lines of neighbouring frames fitted together: where the image did not change, aligned maps must agree.

    minimise over a_f, b_f:   sum_f sum_i rho(w_fi (a_f x_fi + b_f - y_fi))                      anchors of each frame
                  + sum_(f, g) sum_j rho(w_j (a_f x_fj + b_f - a_g x_gj - b_g))                  static pixels of a pair

with rho(r) = sqrt(r^2 + eps^2) - eps as in `affine`. A camera that stands still sees the same depth at the pixels of
the second sum, all over the image, where stereo may know little: so anchors of every frame tell the line of each.
All residuals are linear in the lines, so F is convex. Written r = A theta - t over both sums, every u with |u_i| <= 1
and A^T u = 0 certifies

    F* >= -sum u_i t_i - eps sum (1 - sqrt(1 - u_i^2)),

and u = rho'(r), projected onto A^T u = 0, makes this bound tight at the optimum. Scales are not bounded here: where all
of them come out positive they solve the problem with a_f >= 0 as well, and else the frames must be fitted one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.monocular.affine import ARMIJO, BLENDS, OBJECTIVE_FLOOR

RIDGE = 1e-13
"""Share of the diagonal that keeps the normal equations solvable; the certificate knows nothing of it."""


class Anchors(NamedTuple):
    """What is known of one frame; all [n]."""

    x: np.ndarray
    """The monocular prediction."""
    y: np.ndarray
    """What it is aligned to."""
    weights: np.ndarray
    """Multiply the residuals; positive."""


class Tie(NamedTuple):
    """Pixels that did not change from one frame to another; arrays [m]."""

    first: int
    """Index of a frame."""
    second: int
    """Of the other one."""
    x_first: np.ndarray
    """The prediction of one."""
    x_second: np.ndarray
    """That of the other at the same pixels."""
    weight: float
    """Multiplies the residuals."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """y ~ scales[f] x + shifts[f], both [F], with the certificate of `affine.AffineFit` for all frames together."""

    scales: np.ndarray
    shifts: np.ndarray
    scale_errors: np.ndarray
    """Sandwich standard errors [F]."""
    objective: float
    gap: float
    iterations: int


def fit_joint(
    frames: Sequence[Anchors],
    ties: Sequence[Tie],
    *,
    epsilon: float,
    tolerance: float = 1e-10,
    max_iterations: int = 100,
) -> JointFit:
    """Fit the lines of all frames together.

    Args:
        frames: anchors by frame; one with none is held by its ties alone.
        ties: pairs of frames with the pixels that they share.
        epsilon: smoothing of rho, in units of the weighted residuals; must be positive.
        tolerance: relative duality gap to stop at.
        max_iterations: Newton steps at most; the certificate tells what was reached.
    """
    units = [_Unit.of(frame, [part for tie in ties for part in _of(tie, place)]) for place, frame in enumerate(frames)]
    blocks = [_anchored(place, frame, units[place]) for place, frame in enumerate(frames) if frame.x.size]
    blocks += [_tied(tie, units) for tie in ties if tie.x_first.size]
    problem = _Problem(blocks, 2 * len(frames), epsilon)
    state = problem.solve(tolerance, max_iterations)
    spreads, centres = (np.array([getattr(unit, name) for unit in units]) for name in ("spread", "centre"))
    scales, shifts = state.theta[::2] / spreads, state.theta[1::2]
    return JointFit(
        scales=scales,
        shifts=shifts - scales * centres,
        scale_errors=problem.errors(state.theta)[::2] / spreads,
        objective=problem.objective(state.theta),
        gap=state.gap,
        iterations=state.iterations,
    )


class _Unit(NamedTuple):
    """Centre and spread of a frame's predictions, so that neither offset nor scale of a map matters."""

    centre: float
    spread: float

    @classmethod
    def of(cls, frame: Anchors, others: Sequence[np.ndarray]) -> _Unit:
        x = np.concatenate([frame.x, *others]) if others else frame.x
        if not x.size:
            return cls(0.0, 1.0)
        centre = float(np.median(x))
        return cls(centre, max(float(np.abs(x - centre).mean()), np.finfo(float).tiny))

    def rows(self, x: np.ndarray, weights: np.ndarray | float) -> np.ndarray:
        """What multiplies scale and shift in these units, [n, 2]."""
        return np.stack([(x - self.centre) / self.spread * weights, np.broadcast_to(weights, x.shape)], axis=1)


class _Block(NamedTuple):
    """Residuals matrix @ theta[columns] - target."""

    columns: np.ndarray
    matrix: np.ndarray
    target: np.ndarray


def _of(tie: Tie, frame: int) -> list[np.ndarray]:
    """The predictions of one frame in a tie."""
    return [x for place, x in ((tie.first, tie.x_first), (tie.second, tie.x_second)) if place == frame]


def _columns(*frames: int) -> np.ndarray:
    return np.array([2 * frame + part for frame in frames for part in (0, 1)])


def _anchored(place: int, frame: Anchors, unit: _Unit) -> _Block:
    return _Block(_columns(place), unit.rows(frame.x, frame.weights), frame.weights * frame.y)


def _tied(tie: Tie, units: Sequence[_Unit]) -> _Block:
    first, second = units[tie.first].rows(tie.x_first, tie.weight), units[tie.second].rows(tie.x_second, tie.weight)
    return _Block(_columns(tie.first, tie.second), np.hstack([first, -second]), np.zeros(len(first)))


class _State(NamedTuple):
    theta: np.ndarray
    gap: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _Problem:
    """min over theta of sum rho(A theta - t), A in blocks."""

    blocks: Sequence[_Block]
    size: int
    epsilon: float

    def residual(self, theta: np.ndarray) -> np.ndarray:
        return np.concatenate([block.matrix @ theta[block.columns] - block.target for block in self.blocks])

    def root(self, residual: np.ndarray) -> np.ndarray:
        return np.hypot(residual, self.epsilon)

    def objective(self, theta: np.ndarray) -> float:
        r = self.residual(theta)
        return float((r * (r / (self.root(r) + self.epsilon))).sum())

    def transposed(self, values: np.ndarray) -> np.ndarray:
        """A^T values, [size]."""
        total = np.zeros(self.size)
        for block, part in zip(self.blocks, self._split(values)):
            np.add.at(total, block.columns, part @ block.matrix)
        return total

    def normal(self, curvature: np.ndarray) -> np.ndarray:
        """A^T diag(curvature) A, [size, size]."""
        total = np.zeros((self.size, self.size))
        for block, part in zip(self.blocks, self._split(curvature)):
            total[np.ix_(block.columns, block.columns)] += (block.matrix.T * part) @ block.matrix
        return total

    def _split(self, values: np.ndarray) -> list[np.ndarray]:
        return np.split(values, np.cumsum([len(block.target) for block in self.blocks])[:-1])

    def solve(self, tolerance: float, max_iterations: int) -> _State:
        """Newton with IRLS blending from reweighted least squares; the gap uses the best bound over all iterates."""
        theta, bound, gap, iteration = self._start(), -np.inf, np.inf, 0
        floor = OBJECTIVE_FLOOR * sum(len(block.target) for block in self.blocks) * self.epsilon
        for iteration in range(max_iterations + 1):
            r = self.residual(theta)
            root = self.root(r)
            u = r / root
            value = float((r * (r / (root + self.epsilon))).sum())
            bound = max(bound, self.lower_bound(u))
            gap = max(value - bound, 0.0) / max(value, floor)
            step = None if gap <= tolerance or iteration == max_iterations else self._descend(theta, u, root, value)
            if step is None:
                break
            theta = step
        return _State(theta, gap, iteration)

    def _start(self) -> np.ndarray:
        target = np.concatenate([block.target for block in self.blocks])
        theta, weight = np.zeros(self.size), np.ones(len(target))
        for _ in range(3):
            theta = _solve(self.normal(weight), self.transposed(weight * target))
            weight = 1 / self.root(self.residual(theta))
        return theta

    def _descend(self, theta: np.ndarray, u: np.ndarray, root: np.ndarray, value: float) -> np.ndarray | None:
        """One step that lowers F, or None where none does."""
        gradient = self.transposed(u)
        irls, newton = self.normal(1 / root), self.normal(self.epsilon**2 / root**3)
        for blend in BLENDS:
            step = _solve((1 - blend) * newton + blend * irls, -gradient)
            if self.objective(theta + step) < value + ARMIJO * min(float(gradient @ step), 0.0):
                return theta + step
        return None

    def lower_bound(self, u: np.ndarray) -> float:
        """The dual value of u after making it feasible."""
        best, target = -np.inf, np.concatenate([block.target for block in self.blocks])
        slope = self.transposed(u)
        for room in (1 - u * u, np.ones_like(u)):
            step = _solve(self.normal(room), slope)
            moved = np.concatenate([block.matrix @ step[block.columns] for block in self.blocks])
            feasible = u - room * moved
            feasible /= max(1.0, float(np.abs(feasible).max()))
            square = np.minimum(feasible * feasible, 1.0)
            conjugate = self.epsilon * float((square / (1 + np.sqrt(1 - square))).sum())
            best = max(best, -float(feasible @ target) - conjugate)
        return best

    def errors(self, theta: np.ndarray) -> np.ndarray:
        """Sandwich standard errors [size] of an M-estimator: the diagonal of H^-1 (sum psi^2 z z^T) H^-1."""
        r = self.residual(theta)
        root = self.root(r)
        inverse = np.linalg.pinv(self.normal(self.epsilon**2 / root**3), hermitian=True)
        return np.sqrt(np.maximum(np.diag(inverse @ self.normal((r / root) ** 2) @ inverse), 0))


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of symmetric normal equations; directions that nothing holds stay where they are."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix / scale / scale[:, None] + RIDGE * np.eye(len(matrix))
    return np.linalg.lstsq(scaled, right / scale, rcond=None)[0] / scale

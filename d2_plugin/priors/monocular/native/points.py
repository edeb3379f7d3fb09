"""Sums over the points of the Charbonnier fit (`affine`), compiled (`kernels/fit.cpp`) or by NumPy."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.monocular.native.library import library, run

_double, _pointer = ctypes.c_double, ctypes.c_void_p


class _At(ctypes.Structure):
    """What both calls of kernels/fit.cpp begin with."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *((name, _double) for name in ("a", "b", "epsilon")),
        *((name, _pointer) for name in "pqt"),
    )


class _Sums(_At):
    """d2::Sums of kernels/fit.cpp."""

    _fields_ = (("sums", _pointer),)


class _Duals(_At):
    """d2::Duals of kernels/fit.cpp."""

    _fields_ = (("steps", _double * 4), ("shrink", _double * 2), ("sums", _pointer))


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


class Dual(NamedTuple):
    """Of u that was moved by its room times a step and divided by `shrink`."""

    largest: float
    """Its largest size before the division."""
    product: float
    """Sum of it times t."""
    conjugate: float
    """sum (1 - sqrt(1 - u^2))."""


@dataclass(frozen=True, eq=False)
class Points:
    """The points float64 [n] of r = a p + b q - t, contiguous, and the smoothing of rho."""

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
        """All that a step from (a, b) needs."""
        if library() is None:
            return self._sums(a, b)
        out = np.empty(15)
        run("sums", _Sums(*self._given(a, b), out.ctypes.data))
        value, *rest = out.tolist()
        return Sums(value, (rest[0], rest[1]), *((rest[n], rest[n + 1], rest[n + 2]) for n in (2, 5, 8, 11)))

    def duals(self, a: float, b: float, steps: tuple[Step, Step], shrink: tuple[float, float]) -> tuple[Dual, Dual]:
        """What u at (a, b) gives when it is moved.

        Args:
            a, b: where u is.
            steps: in units of p and of q; the first is times 1 - u^2, the second times 1.
            shrink: what the result is divided by.
        """
        if library() is None:
            return self._duals(a, b, steps, shrink)
        out = np.empty(6)
        moves = (_double * 4)(*steps[0], *steps[1]), (_double * 2)(*shrink)
        run("duals", _Duals(*self._given(a, b), *moves, out.ctypes.data))
        return Dual(*out[:3].tolist()), Dual(*out[3:].tolist())

    def normal(self, curvature: np.ndarray) -> Normal:
        cp = curvature * self.p
        return dot(cp, self.p), dot(cp, self.q), dot(curvature * self.q, self.q)

    @functools.cached_property
    def plain(self) -> Normal:
        """c = 1."""
        return dot(self.p, self.p), dot(self.p, self.q), dot(self.q, self.q)

    def _given(self, a: float, b: float) -> tuple[float, ...]:
        points = self.p, self.q, self.t
        assert all(values.flags.c_contiguous and values.dtype == np.float64 for values in points)
        return len(self.p), a, b, self.epsilon, *(values.ctypes.data for values in points)

    def _sums(self, a: float, b: float) -> Sums:
        r = self.residual(a, b)
        inverse_root = 1 / self.root(r)
        u, sharp = r * inverse_root, self.epsilon * inverse_root
        curvatures = inverse_root, inverse_root * sharp**2, 1 - u * u, u * u
        slope = dot(self.p, u), dot(self.q, u)
        return Sums(dot(r, u / (1 + sharp)), slope, *(self.normal(curvature) for curvature in curvatures))

    def _duals(self, a: float, b: float, steps: tuple[Step, Step], shrink: tuple[float, float]) -> tuple[Dual, Dual]:
        r = self.residual(a, b)
        u = r * (1 / self.root(r))

        def moved(room: np.ndarray, step: Step, by: float) -> Dual:
            given = u - room * (step[0] * self.p + step[1] * self.q)
            feasible = given / by
            square = np.minimum(feasible * feasible, 1.0)
            conjugate = float((square / (1 + np.sqrt(1 - square))).sum())
            return Dual(float(np.abs(given).max()), dot(feasible, self.t), conjugate)

        return moved(1 - u * u, steps[0], shrink[0]), moved(np.ones_like(u), steps[1], shrink[1])


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Inner product on one core: BLAS splits vectors of this length over threads that wait for each other.

    Measured: on a busy machine BLAS takes 20 times as long.
    """
    return float(np.einsum("i,i->", a, b))

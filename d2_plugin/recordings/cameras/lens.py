"""Lens distortion: where a pinhole's pixels lie in the image that was recorded.

Both models are OpenCV's and map an undistorted ray (x, y) at z = 1 to a distorted one, r^2 = x^2 + y^2:

    opencv     x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
                    + 2 p1 x y + p2 (r^2 + 2 x^2), y' alike
    fisheye    theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), theta = atan r

The polynomials fold back at a large radius. Rays beyond the fold have no image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.values import shown

Model = Literal["pinhole", "opencv", "fisheye"]

MODELS: tuple[str, ...] = get_args(Model)
"""No distortion; OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 (trailing zeros may be left out); OpenCV's fisheye k1 k2 k3 k4."""

LARGEST_COEFFICIENT = 1e4  # distortion coefficients beyond this are a damaged file: those of real lenses are below 100
NEVER = 1e-12  # A fold is ignored where 1 / a^2 is below this: it lies a million focal lengths away from the centre


@dataclass(frozen=True, eq=False)
class Lens:
    """How a camera recorded: `K` [3, 3] in pixels, which may have skew, and a distortion of one of `MODELS`."""

    K: np.ndarray
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()

    @property
    def bends(self) -> bool:
        """Whether anything has to be undone: a distortion or skew."""
        return self.model == "fisheye" or any(self.distortion) or bool(self.K[0, 1] != 0)

    @property
    def pinhole(self) -> np.ndarray:
        """K [3, 3] of the undistorted image: the same focal lengths and principal point, no skew."""
        K = self.K.copy()
        K[0, 1] = 0
        return K

    def distort(self, rays: np.ndarray) -> np.ndarray:
        """Distorted rays [..., 2] of undistorted ones [..., 2] at z = 1; NaN beyond the fold of the polynomial."""
        radius = np.linalg.norm(rays, axis=-1, keepdims=True)
        if self.model == "fisheye":
            upper, lower, tangential = _polynomial(self.distortion), _polynomial(()), (0.0, 0.0)
            argument = np.arctan(radius)
            scale = np.where(radius > 0, argument / np.maximum(radius, 1e-300), 1)
        else:
            k1, k2, p1, p2, k3, *k = (*self.distortion, *[0.0] * 8)[:8]
            upper, lower, tangential = _polynomial((k1, k2, k3)), _polynomial(k), (p1, p2)
            argument, scale = radius, np.ones_like(radius)
        with np.errstate(divide="ignore", invalid="ignore"):  # a pole lies beyond the fold
            factor = scale * upper(argument**2) / lower(argument**2)
        bent = rays * factor + _decentring(rays, *tangential)
        return np.where(argument >= _fold(upper, lower), np.nan, bent)

    def recorded_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where the undistorted image's `pixels` [..., 2] lie in the recorded one (centres at i + 0.5)."""
        K = self.pinhole
        rays = self.distort((pixels - K[:2, 2]) / K[[0, 1], [0, 1]])
        return rays @ self.K[:2, :2].T + self.K[:2, 2]


def checked_lens(K: np.ndarray, model: str, distortion: np.ndarray | tuple[float, ...], where: str) -> Lens:
    """A `Lens`, whose coefficients are those of its model.

    Raises:
        D2Error: no K, an unknown model, a coefficient that no lens has, or one that the model has no place for, as of
            thin prism and tilted models.
    """
    refuse_unknown(f"camera model of {where}", [model], MODELS)
    if not np.allclose((K[1, 0], *K[2]), (0, 0, 0, 1)):
        raise D2Error(f"{where} has a K that is not fx skew cx, 0 fy cy, 0 0 1: correct the calibration")
    values = np.ravel(np.asarray(distortion, np.float64))
    if not (np.abs(values) <= LARGEST_COEFFICIENT).all():
        raise D2Error(
            f"{where} has distortion coefficients {shown(values.tolist())}, expected finite numbers of at most "
            f"{LARGEST_COEFFICIENT:g} in size: correct the calibration"
        )
    most = {"pinhole": 0, "opencv": 8, "fisheye": 4}[model]
    if values[most:].any():
        expected = {"pinhole": "none", "opencv": "k1 k2 p1 p2 and k3 to k6 only", "fisheye": "k1 k2 k3 k4"}[model]
        raise D2Error(
            f"{where} has {values.size} distortion coefficients, and a camera of the model {model} has {expected}: "
            "correct its model, or undistort the images first"
        )
    return Lens(K, model, tuple(values[:most].tolist()))


def _polynomial(coefficients: Sequence[float]) -> np.polynomial.Polynomial:
    return np.polynomial.Polynomial([1.0, *coefficients])


def _decentring(rays: np.ndarray, p1: float, p2: float) -> np.ndarray:
    x, y = rays[..., 0], rays[..., 1]
    square = x * x + y * y
    shift_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
    shift_y = 2 * p2 * x * y + p1 * (square + 2 * y * y)
    return np.stack([shift_x, shift_y], axis=-1)


def _fold(upper: np.polynomial.Polynomial, lower: np.polynomial.Polynomial) -> float:
    """Smallest a > 0 where a N(a^2) / D(a^2) stops growing, or has a pole; infinite where it never does.

    The slope is zero where (N + 2 s N') D - 2 s N D' is, s = a^2.
    """
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = (upper + 2 * s * upper.deriv()) * lower - 2 * s * upper * lower.deriv()
    return min(_first_root(slope.coef), _first_root(lower.coef))


def _first_root(coefficients: np.ndarray) -> float:
    """The smallest a > 0 at whose square a polynomial, which is 1 at 0, is zero; infinite where there is none."""
    inverse = np.roots(coefficients)  # of 1 / a^2: the leading coefficient is 1, so tiny k cannot overflow
    positive = (inverse.real > NEVER) & (np.abs(inverse.imag) < 1e-9 * np.abs(inverse))
    return float(1 / np.sqrt(inverse.real[positive].max())) if positive.any() else np.inf

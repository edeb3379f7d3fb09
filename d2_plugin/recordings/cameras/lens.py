"""Lens distortion, undone when an image is read: from here on every camera is a pinhole.

Both models are OpenCV's and map an undistorted ray (x, y) at z = 1 to a distorted one, r^2 = x^2 + y^2:

    radial-tangential   x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
                             + 2 p1 x y + p2 (r^2 + 2 x^2), y' alike
    fisheye             theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), theta = atan r

The polynomials fold back at a large radius. Rays beyond the fold have no image and are black, as are pixels outside
the recorded image: the size and the focal length are kept, so nothing is cropped or stretched.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera, MaskedSource, Source

KEPT_MAPS = 8
"""Cameras whose resampling map stays in memory (6 bytes per pixel each)."""

COVERAGE_STEP = 8
"""Grid step in pixels, across and down, for measuring how much of an image is black."""

LARGEST_COEFFICIENT = 1e4
"""Distortion coefficients beyond this are a damaged file: those of real lenses are below 100."""

MOST_BLACK = 0.5
"""Share of an undistorted image that may be without a recorded pixel: more is a wrong coefficient."""

NEVER = 1e-12
"""A fold is ignored where 1 / a^2 is below this: it lies a million focal lengths away from the centre."""


@dataclass(frozen=True, eq=False)
class Lens:
    """How a camera recorded: `K` [3, 3] in pixels, which may have skew, and the coefficients of a distortion model."""

    K: np.ndarray
    radial: tuple[float, ...] = ()  # k1, k2, ... in the order of powers
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2
    fisheye: bool = False
    denominator: tuple[float, ...] = ()  # k4, k5, k6 of the rational model

    @property
    def bends(self) -> bool:
        """Whether anything has to be undone: a distortion or skew."""
        coefficients = (*self.radial, *self.tangential, *self.denominator)
        return self.fisheye or any(coefficients) or bool(self.K[0, 1] != 0)

    @property
    def pinhole(self) -> np.ndarray:
        """K [3, 3] of the undistorted image: the same focal lengths and principal point, no skew."""
        K = self.K.copy()
        K[0, 1] = 0
        return K

    def distort(self, rays: np.ndarray) -> np.ndarray:
        """Distorted rays [..., 2] of undistorted ones [..., 2] at z = 1; NaN beyond the fold of the polynomial."""
        radius = np.linalg.norm(rays, axis=-1, keepdims=True)
        argument = np.arctan(radius) if self.fisheye else radius
        square = argument**2
        factor = 1 + sum(k * square**power for power, k in enumerate(self.radial, start=1))
        if self.denominator:
            with np.errstate(divide="ignore", invalid="ignore"):  # a pole lies beyond the fold
                factor = factor / (1 + sum(k * square**power for power, k in enumerate(self.denominator, start=1)))
        if self.fisheye:
            factor = factor * np.where(radius > 0, argument / np.maximum(radius, 1e-300), 1)
        folded = argument >= _fold(self.radial, self.denominator)
        return np.where(folded, np.nan, rays * factor + self._decentring(rays))

    def recorded_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where the undistorted image's `pixels` [..., 2] lie in the recorded one (centres at i + 0.5)."""
        K = self.pinhole
        rays = self.distort((pixels - K[:2, 2]) / K[[0, 1], [0, 1]])
        return rays @ self.K[:2, :2].T + self.K[:2, 2]

    def _decentring(self, rays: np.ndarray) -> np.ndarray:
        if not any(self.tangential):
            return np.zeros_like(rays)
        (p1, p2), x, y = self.tangential, rays[..., 0], rays[..., 1]
        square = x * x + y * y
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        shift_y = 2 * p2 * x * y + p1 * (square + 2 * y * y)
        return np.stack([shift_x, shift_y], axis=-1)


@dataclass(frozen=True)
class UndistortedSource:
    """The images of `source` as pinhole cameras would have taken them; maps on disk fit these already."""

    source: Source
    lenses: Mapping[str, Lens]
    sizes: Mapping[str, tuple[int, int]]
    _maps: dict[str, Resampling] = field(default_factory=dict, repr=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3], bilinear, black where nothing was recorded."""
        return self._undone(camera, self.source.image(camera, frame))

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z of the undistorted image as it lies on disk, or None."""
        return self.source.depth(camera, frame)

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """A monocular map of the undistorted image as it lies on disk, or None."""
        return self.source.mono(camera, frame)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        """The mask of the recorded image, undistorted with it, or None."""
        mask = self.source.mask(camera, frame) if isinstance(self.source, MaskedSource) else None
        return None if mask is None else self._undone(camera, mask)

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels [H, W] of the undistorted image were recorded, or None where all were."""
        valid = self.source.recorded(camera) if isinstance(self.source, MaskedSource) else None
        if camera not in self.lenses:
            return valid
        here = recorded_pixels(self.lenses[camera], self.sizes[camera])
        if valid is not None:
            here &= self._undone(camera, valid.astype(np.float32)) > 0.99
        return None if here.all() else here

    def _undone(self, camera: str, image: np.ndarray) -> np.ndarray:
        if camera not in self.lenses:
            return image
        width, height = self.sizes[camera]
        if image.shape[:2] != (height, width):
            return image  # `Recording.image` refuses it in its own words
        return resampled(image, self._map(camera))

    def __reduce__(self) -> tuple[Any, ...]:  # maps are made anew in another process
        return UndistortedSource, (self.source, self.lenses, self.sizes)

    def _map(self, camera: str) -> Resampling:
        if camera not in self._maps:
            self._maps[camera] = resampling(self.lenses[camera], self.sizes[camera])
            while len(self._maps) > KEPT_MAPS:
                del self._maps[next(iter(self._maps))]
        return self._maps[camera]


Resampling = tuple[Any, Any]
"""Where each pixel of an undistorted image comes from, as `cv2.remap` wants it."""


def resampling(lens: Lens, size: tuple[int, int]) -> Resampling:
    """How recorded images of `size` (width, height) become undistorted ones."""
    cv2 = opencv("undoing lens distortion")
    positions = np.nan_to_num(_recorded_grid(lens, size, step=1) - 0.5, nan=-10.0)  # cv2 puts centres on integers
    maps: Resampling = cv2.convertMaps(positions.astype(np.float32), None, cv2.CV_16SC2)
    return maps


def resampled(image: np.ndarray, maps: Resampling) -> np.ndarray:
    """The undistorted image [H, W] or [H, W, C], bilinear, 0 where nothing was recorded."""
    cv2 = opencv("undoing lens distortion")
    undone: np.ndarray = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return undone


def recorded_pixels(lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Which pixels of the undistorted image were recorded, bool [H, W]; those half beyond the edge were not."""
    x, y = np.moveaxis(_recorded_grid(lens, size, step=1), -1, 0)
    inside: np.ndarray = (x >= 0.5) & (x <= size[0] - 0.5) & (y >= 0.5) & (y <= size[1] - 0.5)  # NaN is outside
    return inside


def opencv_lens(K: np.ndarray, coefficients: np.ndarray, where: str) -> Lens:
    """The lens of OpenCV's coefficient vector k1 k2 p1 p2 [k3 [k4 k5 k6]], where zeros mean none.

    Raises:
        D2Error: more coefficients than eight that are not zero (thin prism and tilted models).
    """
    values = np.zeros(max(8, np.size(coefficients)))
    values[: np.size(coefficients)] = np.ravel(coefficients)
    if not np.isfinite(values).all():
        raise D2Error(f"{where} has a distortion coefficient that is not finite: correct the calibration")
    if values[8:].any():
        raise D2Error(
            f"{where} has {np.size(coefficients)} distortion coefficients, expected k1 k2 p1 p2 and k3 to k6 only: "
            "undistort the images first"
        )
    k1, k2, p1, p2, *more = (float(value) for value in values[:8])
    return Lens(K, (k1, k2, more[0]), (p1, p2), denominator=tuple(more[1:]) if any(more[1:]) else ())


def black_share(lens: Lens, camera: Camera) -> float:
    """Share of the undistorted image that was not recorded, from a coarse grid."""
    x, y = np.moveaxis(_recorded_grid(lens, (camera.width, camera.height), COVERAGE_STEP), -1, 0)
    inside = (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
    return 1 - float(inside.mean())


def refuse_black(share: float, name: str) -> None:
    """Raise for a lens that leaves hardly anything of the images of camera `name`."""
    if share > MOST_BLACK:
        raise D2Error(
            f"undoing the lens distortion of camera {name} leaves {1 - share:.0%} of its images, expected at least "
            f"{1 - MOST_BLACK:.0%}: correct its distortion coefficients and their model"
        )


def _recorded_grid(lens: Lens, size: tuple[int, int], step: int) -> np.ndarray:
    """Recorded positions [h, w, 2] of every `step`-th pixel's centre."""
    columns, rows = (np.arange(0, length, step) + 0.5 for length in size)
    return lens.recorded_pixels(np.stack(np.meshgrid(columns, rows), axis=-1))


def _fold(radial: tuple[float, ...], denominator: tuple[float, ...] = ()) -> float:
    """Smallest argument a > 0 where a N(a^2) / D(a^2) stops growing, or has a pole; infinite where it never does.

    N and D are 1 + k a^2 + ... of the coefficients. The slope is zero where (N + 2 s N') D - 2 s N D' is, s = a^2.
    """
    upper, lower = (np.polynomial.Polynomial([1.0, *values]) for values in (radial, denominator))
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = (upper + 2 * s * upper.deriv()) * lower - 2 * s * upper * lower.deriv()
    return min(_first_root(slope.coef), _first_root(lower.coef))


def _first_root(coefficients: np.ndarray) -> float:
    """The smallest a > 0 at whose square a polynomial, which is 1 at 0, is zero; infinite where there is none."""
    inverse = np.roots(coefficients)  # of 1 / a^2: the leading coefficient is 1, so tiny k cannot overflow
    positive = (inverse.real > NEVER) & (np.abs(inverse.imag) < 1e-9 * np.abs(inverse))
    return float(1 / np.sqrt(inverse.real[positive].max())) if positive.any() else np.inf

"""Draws the image that a page wants, as large as fits its time, and sends it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from d2_plugin.viewing.live.page import Page, Wanted
from d2_plugin.viewing.panels import KINDS, Shot

MOVING_QUALITY, STILL_QUALITY = 60, 90
"""JPEG quality."""
SMALLEST = 72
"""Height in pixels below which no image is drawn, however slow."""
KEPT = 0.85
"""What a measurement still weighs when the next one comes."""
APART = 0.1
"""Spread of sizes, relative to their mean, from which both costs of an image can be told apart."""
SAVED = 0.5
"""Seconds of time whose share may be saved up."""


class Resolution:
    """What an image costs however small and what a pixel costs: a straight line through the last measurements. With it
    a moving image is as large as fits its time. player/pace.js does the same."""

    def __init__(self) -> None:
        self._sums = np.array([1e-6, 1e-1, 1e-8, 1e4, 1e-3])

    def drew(self, pixels: int, seconds: float) -> None:
        """Note an image."""
        self._sums = KEPT * self._sums + (1.0, pixels, seconds, pixels * pixels, pixels * seconds)

    def size(self, aspect: float, most: int, seconds: float | None = None) -> tuple[int, int]:
        """Width and height, at most `most` pixels high, that take about `seconds`; None is as large as allowed.

        Where an image costs as much however small, half as much goes into its pixels: fewer would gain little."""
        height = most
        if seconds is not None:
            x, y, xx, xy = self._sums[1:] / self._sums[0]
            spread, whole = xx - x * x, y / x
            slope = (xy - x * y) / spread if spread > (APART * x) ** 2 else 0.0
            pixel = min(slope, whole) if slope > 0 else whole  # smaller ones took longer: the machine has other work
            fixed = y - pixel * x
            left = max(seconds - fixed, 0.5 * fixed, 1e-3)
            height = int(min(left / max(pixel, 1e-12) / max(aspect, 1e-3), 1e9) ** 0.5)
        height = max(min(height, most), min(SMALLEST, most))
        return max(round(height * aspect), 1), height


@dataclass
class Share:
    """Lets work take a share of the time that passes; what was not used is kept for a moment only."""

    share: float
    spent: float = 0.0
    """Seconds of work that are still to be paid off."""

    def passes(self, seconds: float) -> None:
        """Time has passed."""
        self.spent = max(self.spent - self.share * seconds, -SAVED * self.share)

    @property
    def due(self) -> bool:
        """Whether there is time for more."""
        return self.spent <= 0


def draw(page: Page, wanted: Wanted, marked: Tensor | None, seconds: float | None, resolution: Resolution) -> None:
    """Send one image; where something moves, it is as large as fits `seconds`."""
    scene, viewed = page.client.scene, page.viewed
    if not wanted.show:
        scene.set_background_image(None)
        page.set_text("size", "none")
        return
    start = time.perf_counter()
    size = resolution.size(wanted.aspect, wanted.height, seconds)
    known = wanted.marked and marked is not None and len(marked) == len(viewed.backbone)
    view, compared = viewed.view(wanted.camera(*size), wanted.time), wanted.recorded > 0 or wanted.show == "error"
    if wanted.standing is not None and compared:
        camera, frame = viewed.recording.cameras[wanted.standing], viewed.frame_at(wanted.time, wanted.standing)
        shape = max(round(size[1] * camera.width / camera.height), 1), size[1]
        view = viewed.view(camera, viewed.recording.seconds(frame, camera.name), shape)
    shot = Shot(viewed, view, None, marked if known else None)
    image = KINDS[wanted.show](shot).image
    if wanted.recorded > 0:
        image = np.rint((1 - wanted.recorded) * image + wanted.recorded * shot.truth).astype(np.uint8)
    quality = STILL_QUALITY if seconds is None else MOVING_QUALITY
    scene.set_background_image(_filled(image, size[0]), format="jpeg", jpeg_quality=quality)
    taken = time.perf_counter() - start
    resolution.drew(size[0] * size[1], taken)
    page.set_text("size", f"{size[0]}x{size[1]}, {1000 * taken:.0f} ms")


def _filled(image: np.ndarray, width: int) -> np.ndarray:
    """The image [H, W, 3] with another width: black is added, or cut, alike on both sides."""
    missing = max(width - image.shape[1], 0)
    cut = max(image.shape[1] - width, 0) // 2
    return np.pad(image, ((0, 0), (missing // 2, missing - missing // 2), (0, 0)))[:, cut : cut + width]

"""Draws the image that a page wants and sends it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from d2_plugin.runs.drawing import color_scale, colorize
from d2_plugin.viewing.live.pace import Resolution
from d2_plugin.viewing.live.page import Page, Wanted
from d2_plugin.viewing.look import Look, gaussians_per_pixel, look
from d2_plugin.viewing.panels import MOST_GAUSSIANS, as_bytes, depth_image, depth_scale

MOVING_QUALITY, STILL_QUALITY = 60, 90
"""JPEG quality."""


@dataclass
class Drawer:
    """One for all pages: what a pixel costs is learnt from every image."""

    resolution: Resolution = field(default_factory=Resolution)

    def draw(self, page: Page, wanted: Wanted, marked: Tensor | None, seconds: float | None) -> None:
        """Send one image; where something moves, it is as large as fits `seconds`."""
        scene = page.client.scene
        if not wanted.show:
            scene.set_background_image(None)
            page.say("size", "none")
            return
        start = time.perf_counter()
        size = self.resolution.size(wanted.aspect, wanted.height, seconds)
        image = paint(page, wanted, size, marked)
        quality = STILL_QUALITY if seconds is None else MOVING_QUALITY
        scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        taken = time.perf_counter() - start
        self.resolution.drew(size[0] * size[1], taken)
        page.say("size", f"{size[0]}x{size[1]}, {1000 * taken:.0f} ms")


def paint(page: Page, wanted: Wanted, size: tuple[int, int], marked: Tensor | None) -> np.ndarray:
    """The image, RGB uint8 [H, W, 3]."""
    subject = page.subject
    view = subject.view(wanted.camera(*size), wanted.time, size)
    chosen = marked if wanted.marked and marked is not None and len(marked) == len(subject.backbone) else None
    seen = look(subject.backbone, view, wanted.min_opacity, chosen)
    if wanted.show == "count":
        count = gaussians_per_pixel(seen.splats, view, subject.backbone.settings).numpy()
        return colorize(np.log1p(count), 0, float(np.log1p(MOST_GAUSSIANS)), color_scale("inferno"))
    return _shown(seen, wanted.show)


def _shown(seen: Look, show: str) -> np.ndarray:
    if show == "depth":
        depth = seen.depth.numpy()
        return depth_image(depth, depth_scale([depth]))
    if show == "alpha":
        return as_bytes(seen.alpha.numpy()[..., None].repeat(3, -1))
    return as_bytes(seen.color.numpy())

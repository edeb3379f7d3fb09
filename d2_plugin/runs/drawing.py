"""Images beside each other with captions and colour scales. Images here are RGB uint8 [H, W, 3]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_VIRIDIS = "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
_INFERNO = "000004 1b0c41 4a0c6b 781c6d a52c60 cf4446 ed6925 fb9b06 f7d13d fcffa4"

BACKGROUND, INK = 24, 235
GAP = 4
"""Pixels between panels."""


class Panel(NamedTuple):
    """An image with the text above it."""

    caption: str
    image: np.ndarray
    bar: np.ndarray | None = None  # colours [N, 3] of the scale shown under the caption


def colorize(values: np.ndarray, low: float, high: float, colors: np.ndarray) -> np.ndarray:
    """Colours uint8 [H, W, 3] of `values` [H, W] on a scale from `low` to `high`, clipped at its ends."""
    place = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * (len(colors) - 1)
    return colors[np.rint(place).astype(np.int64)]


def color_scale(name: str, steps: int = 256) -> np.ndarray:
    """Colours uint8 [steps, 3] of `viridis` (depth, near is dark) or `inferno` (error, none is black)."""
    anchors = np.array([list(bytes.fromhex(code)) for code in {"viridis": _VIRIDIS, "inferno": _INFERNO}[name].split()])
    place = np.linspace(0, len(anchors) - 1, steps)
    channels = [np.interp(place, np.arange(len(anchors)), anchors[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def text(line: str, size: int = 1) -> np.ndarray:
    """Light letters on the background, uint8 [10 size, W, 3].

    Without OpenCV, which draws the letters, an empty strip of one pixel.
    """
    try:
        import cv2
    except ImportError:
        return np.full((10 * size, 1, 3), BACKGROUND, np.uint8)
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.3 * size
    (width, _), _ = cv2.getTextSize(line, font, scale, size)
    strip = np.full((10 * size, max(width, 1), 3), BACKGROUND, np.uint8)
    cv2.putText(strip, line, (0, 8 * size), font, scale, (INK,) * 3, size, cv2.LINE_AA)
    return strip


def side_by_side(panels: Sequence[Panel]) -> np.ndarray:
    """All panels in one row, each with its caption and colour scale above; a caption too long for its panel is cut."""
    size = int(np.clip(max(panel.image.shape[1] for panel in panels) // 300, 1, 4))  # of the letters, in pixels
    header = 20 * size
    height = header + max(panel.image.shape[0] for panel in panels)
    row: list[np.ndarray] = []
    for panel in panels:
        width = panel.image.shape[1]
        canvas = np.full((height, width, 3), BACKGROUND, np.uint8)
        letters = text(panel.caption, size)[:, : width - 2 * size]
        canvas[size : size + letters.shape[0], 2 * size : 2 * size + letters.shape[1]] = letters
        if panel.bar is not None:
            place = np.linspace(0, len(panel.bar) - 1, width).astype(int)
            canvas[13 * size : 18 * size] = panel.bar[place]
        canvas[header : header + panel.image.shape[0]] = panel.image
        row += [canvas, np.full((height, GAP, 3), BACKGROUND, np.uint8)]
    return np.concatenate(row[:-1], axis=1)

"""Images beside each other with captions and colour scales. Images here are RGB uint8 [H, W, 3]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.images import opencv

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


def captioned(caption: str, image: np.ndarray, bar: np.ndarray | None = None, size: int = 1) -> np.ndarray:
    """The image below a line of text, white on dark, and below the colours [N, 3] of a scale.

    `size` multiplies the height of the text, 20 pixels; what is too long is cut, what is not ASCII shows as '?'.
    """
    cv2 = opencv("the captions of images")
    header = np.full((20 * size, image.shape[1], 3), BACKGROUND, np.uint8)
    font = cv2.FONT_HERSHEY_SIMPLEX, 0.33 * size, (INK,) * 3, size, cv2.LINE_AA
    cv2.putText(header, caption, (2 * size, 10 * size), *font)
    if bar is not None:
        header[13 * size : 18 * size] = bar[np.linspace(0, len(bar) - 1, image.shape[1]).astype(int)]
    return np.concatenate([header, image])


def side_by_side(panels: Sequence[Panel]) -> np.ndarray:
    """All panels in one row, each with its caption and colour scale above."""
    size = int(np.clip(max(panel.image.shape[1] for panel in panels) // 300, 1, 4))
    drawn = [captioned(panel.caption, panel.image, panel.bar, size) for panel in panels]
    height = max(image.shape[0] for image in drawn)
    row = [np.pad(image, ((0, height - len(image)), (0, GAP), (0, 0)), constant_values=BACKGROUND) for image in drawn]
    return np.concatenate(row, axis=1)[:, :-GAP]

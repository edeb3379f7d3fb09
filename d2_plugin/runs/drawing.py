"""Images beside each other with captions and colour scales. Images here are RGB uint8 [H, W, 3]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.images import opencv

BACKGROUND, INK = 24, 235
GAP = 4
"""Pixels between panels."""
ERROR_SHOWN = 0.25
"""Absolute colour error, mean over channels, at the bright end of its scale."""

Scale = tuple[float, float]


class Panel(NamedTuple):
    """An image with the text above it."""

    caption: str
    image: np.ndarray
    bar: np.ndarray | None = None  # colours [N, 3] of the scale shown under the caption


def colorize(values: np.ndarray, low: float, high: float, colors: np.ndarray) -> np.ndarray:
    """Colours uint8 [H, W, 3] of `values` [H, W] on a scale from `low` to `high`, clipped at its ends."""
    place = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * (len(colors) - 1)
    return colors[np.rint(place).astype(np.int64)]


def depth_scale(depths: Sequence[np.ndarray]) -> Scale:
    """1st and 99th percentile of the known depths of several maps; (0, 1) where none is known."""
    known = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths]) if depths else np.zeros(0)
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high)


def depth_panel(title: str, depth: np.ndarray, depths: Scale | None, note: str = "") -> Panel:
    """Near is dark; black where nothing is known."""
    low, high = depths or depth_scale([depth])
    known, scale = np.isfinite(depth) & (depth > 0), color_scale("viridis")
    image = colorize(np.where(known, depth, 0), low, high, scale)
    return Panel(f"{title} {low:.3g}..{high:.3g}{note}", np.where(known[..., None], image, np.uint8(0)), scale)


def error_panel(error: np.ndarray, note: str = "") -> Panel:
    """Absolute errors [H, W, 3] of colour."""
    scale = color_scale("inferno")
    return Panel(f"error 0..{ERROR_SHOWN:g}{note}", colorize(error.mean(-1), 0, ERROR_SHOWN, scale), scale)


def color_scale(name: str) -> np.ndarray:
    """Colours uint8 [256, 3] of `viridis` (depth, near is dark) or `inferno` (error, none is black)."""
    cv2 = opencv("drawing images")
    colors = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{name.upper()}"))
    return np.ascontiguousarray(colors[:, 0, ::-1])


def text(line: str, size: int = 1) -> np.ndarray:
    """Light letters on the background, uint8 [10 size, W, 3]."""
    cv2 = opencv("drawing images")
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

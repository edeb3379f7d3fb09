"""Images beside each other with captions and colour scales, drawn with numpy alone.

A training machine has torch and numpy and perhaps nothing else: held-out images must not need a plotting library.
Images here are RGB uint8 [H, W, 3].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# The 5 x 7 letters of character displays, ASCII 32 to 126: five columns each, one byte per column, top row lowest bit.
_LETTERS = np.frombuffer(
    bytes.fromhex(
        "000000000000005F00000007000700147F147F14242A7F2A12231308646236495620500008070300001C2241000041221C00"
        "2A1C7F1C2A08083E080800807030000808080808000060600020100804023E5149453E00427F400072494949462141494D33"
        "1814127F1027454545393C4A49493141211109073649494936464949291E0000140000004034000000081422411414141414"
        "004122140802015909063E415D594E7C1211127C7F494949363E414141227F4141413E7F494949417F090909013E41415173"
        "7F0808087F00417F41002040413F017F081422417F404040407F021C027F7F0408107F3E4141413E7F090909063E4151215E"
        "7F09192946264949493203017F01033F4040403F1F2040201F3F4038403F631408146303047804036159494D43007F414141"
        "0204081020004141417F04020102044040404040000307080020545478407F284444383844444428384444287F3854545418"
        "00087E090218A4A49C787F0804047800447D40002040403D007F1028440000417F40007C047804787C080404783844444438"
        "FC1824241818242418FC7C08040408485454542404043F44243C4040207C1C2040201C3C4030403C44281028444C9090907C"
        "4464544C440008364100000077000000413608000201020402"
    ),
    np.uint8,
).reshape(95, 5)

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
    """White letters on the background, [8 size, 6 size len(line), 3]; what is not ASCII shows as '?'."""
    codes = [ord(letter) if 32 <= ord(letter) < 127 else ord("?") for letter in line]
    columns = np.zeros((len(codes), 6), np.uint8)
    columns[:, :5] = _LETTERS[np.array(codes, int) - 32].reshape(-1, 5)
    bits = np.unpackbits(columns.reshape(1, -1), axis=0, bitorder="little")
    return np.where(bits, INK, BACKGROUND).astype(np.uint8).repeat(size, 0).repeat(size, 1)[..., None].repeat(3, 2)


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
        canvas[2 * size : 2 * size + letters.shape[0], 2 * size : 2 * size + letters.shape[1]] = letters
        if panel.bar is not None:
            place = np.linspace(0, len(panel.bar) - 1, width).astype(int)
            canvas[13 * size : 18 * size] = panel.bar[place]
        canvas[header : header + panel.image.shape[0]] = panel.image
        row += [canvas, np.full((height, GAP, 3), BACKGROUND, np.uint8)]
    return np.concatenate(row[:-1], axis=1)

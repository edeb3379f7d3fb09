"""Masks beside the images of a recording; none is ever required.

masks/<camera>/<frame>.png says what is foreground: people, or whatever the scene is about. White counts fully, grey in
part. EasyMocap's mask/, ENeRF's and EasyVolcap's bgmtv2/ and Diffuman4D's fmasks/ are the same under other names.
valid/<camera>.png says which pixels were recorded at all: undistorting leaves some without. Black was not recorded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.recordings.images import read_numbers, write_png

MASK_FOLDERS = ("masks", "fmasks", "mask", "bgmtv2")
"""Where foreground masks lie, in the order in which they are tried: plain and EasyMocap, Diffuman4D, EasyMocap,
ENeRF and EasyVolcap."""

VALID_FOLDER = "valid"


def read_mask(path: Path) -> np.ndarray:
    """An image of any number of channels as one number per pixel, 0..1: its opacity where it has one."""
    stored = read_numbers(path)
    full = float(np.iinfo(stored.dtype).max) if np.issubdtype(stored.dtype, np.integer) else 1.0
    if stored.ndim == 3:
        stored = stored[..., 3] if stored.shape[2] == 4 else stored.max(axis=2)
    return (stored.astype(np.float32) / np.float32(full)).clip(0, 1)


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask [H, W] in 0..1, or of true and false, as a grey image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    grey = np.rint(mask.astype(np.float32) * 255).astype(np.uint8)
    write_png(path, np.repeat(grey[..., None], 3, axis=2))

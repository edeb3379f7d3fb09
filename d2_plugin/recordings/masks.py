"""Masks beside the images of a recording; none is ever required.

masks/<camera>/<frame>.png says what is foreground: people, or whatever the scene is about. White counts fully, grey in
part. EasyMocap's mask/, ENeRF's and EasyVolcap's bgmtv2/ and Diffuman4D's fmasks/ are the same under other names.
valid/<camera>.png says which pixels were recorded at all: undistorting leaves some without. Black was not recorded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from d2_plugin.recordings.files import FrameFiles, numbered_files
from d2_plugin.recordings.images import IMAGE_SUFFIXES, read_numbers

MASK_FOLDERS = ("masks", "fmasks", "mask", "bgmtv2")
"""Where foreground masks lie, in the order in which they are looked for: plain and EasyMocap, Diffuman4D, EasyMocap,
ENeRF and EasyVolcap."""

VALID_FOLDER = "valid"


@dataclass(frozen=True)
class MaskFiles:
    """The masks of a recording as files; every read opens one file."""

    foreground: Mapping[str, FrameFiles] = field(default_factory=dict)
    valid: Mapping[str, Path] = field(default_factory=dict)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        """How much each pixel is foreground, float32 [H, W] in 0..1, or None where nobody says."""
        path = self.foreground.get(camera, {}).get(frame)
        return None if path is None else _grey(path)

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels were recorded, bool [H, W], or None where all were."""
        path = self.valid.get(camera)
        return None if path is None else _grey(path) > 0.5


NO_MASKS = MaskFiles()


def find_masks(path: Path, cameras: Iterable[str]) -> tuple[MaskFiles, tuple[str, ...]]:
    """(the masks that lie beside the images of a recording, a note that says which)."""
    names = list(cameras)
    valid = {name: path / VALID_FOLDER / f"{name}.png" for name in names}
    valid = {name: file for name, file in valid.items() if file.is_file()}
    for folder in (path / name for name in MASK_FOLDERS):
        of_camera = {name: folder / name for name in names if (folder / name).is_dir()}
        found = {name: files for name, place in of_camera.items() if (files := numbered_files(place, IMAGE_SUFFIXES))}
        if found:
            some = "" if len(found) == len(names) else f" of {', '.join(found)}"
            return MaskFiles(found, valid), (f"foreground masks{some} from {folder.name}",)
    return MaskFiles({}, valid), ()


def _grey(path: Path) -> np.ndarray:
    """An image of any number of channels as one number per pixel, 0..1: its opacity where it has one."""
    stored = read_numbers(path)
    full = float(np.iinfo(stored.dtype).max) if np.issubdtype(stored.dtype, np.integer) else 1.0
    if stored.ndim == 3:
        stored = stored[..., 3] if stored.shape[2] == 4 else stored.max(axis=2)
    return (stored.astype(np.float32) / np.float32(full)).clip(0, 1)


def as_image(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] in 0..1 as the grey image [H, W, 3] that is written."""
    return np.repeat(np.rint(mask.astype(np.float32) * 255).astype(np.uint8)[..., None], 3, axis=2)

"""A recording put together from image files: what all readers of images on disk have in common.

Beside the images, whatever the layout, there may be depth/<camera>/<frame>.npz with true planar z under the key
"depth" (0 = unknown) and mono/<camera>/<frame>.npy with a monocular prediction: affine-invariant inverse depth, unless
mono/mono.json says otherwise with {"kind": "metric" | "relative", "emulated": bool}. Masks: see `masks`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.reading import read_bytes, read_json
from d2_plugin.recordings.cameras.lens import LARGEST_COEFFICIENT, Lens, UndistortedSource, black_share, refuse_black
from d2_plugin.recordings.files import FrameFiles, numbered_files
from d2_plugin.recordings.images import read_image
from d2_plugin.recordings.masks import NO_MASKS, MaskFiles, find_masks
from d2_plugin.recordings.recording import Camera, MonoKind, Recording, Source
from d2_plugin.values import shown

log = logging.getLogger(__name__)

BLACK_NOTED = 1e-3
"""Black share of an undistorted image above which a note reports it."""

CORRECT = "correct the file, see docs/recordings.md"
REPLACE = "replace the file or remove it"


@dataclass(frozen=True)
class FolderSource:
    """Images and maps as files; every read opens one file."""

    images: dict[str, FrameFiles]
    depths: dict[str, FrameFiles]
    monos: dict[str, FrameFiles]
    masks: MaskFiles = NO_MASKS

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        path = self.images[camera].get(frame)
        if path is None:
            raise D2Error(f"camera {camera} has no frame {frame}: choose one of the recording's frames")
        return read_image(path)

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z float32 [H, W], 0 where unknown, or None."""
        path = self.depths.get(camera, {}).get(frame)
        if path is None:
            return None
        depth = _map(path, "depth")
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """Monocular map float32 [h, w] exactly as stored (holes and NaN included), or None."""
        path = self.monos.get(camera, {}).get(frame)
        return None if path is None else _map(path, None)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        """How much each pixel is foreground, float32 [H, W] in 0..1, or None."""
        return self.masks.mask(camera, frame)

    def recorded(self, camera: str) -> np.ndarray | None:
        """Which pixels were recorded, bool [H, W], or None where all were."""
        return self.masks.recorded(camera)


def assembled(
    path: Path,
    cameras: dict[str, Camera],
    images: Mapping[str, FrameFiles],
    frames: tuple[int, ...],
    fps: float,
    notes: Iterable[str] = (),
    lenses: Mapping[str, Lens] | None = None,
) -> Recording:
    """The recording of `cameras` (pinholes) whose images are `images`; every note is also logged.

    `lenses` describes the cameras whose recorded images are distorted; those are undistorted when read.
    """
    kind, emulated, mono_notes = _mono_description(path)
    monos = _maps(path / "mono", list(cameras), ".npy")
    masks, mask_notes = find_masks(path, cameras)
    source: Source = FolderSource(dict(images), _maps(path / "depth", list(cameras), ".npz"), monos, masks)
    for name, lens in (lenses or {}).items():
        _check_lens(lens, name, path)
    bent = {name: lens for name, lens in (lenses or {}).items() if name in cameras and lens.bends}
    if bent:
        source = UndistortedSource(source, bent, {name: (cameras[name].width, cameras[name].height) for name in bent})
    all_notes = (*notes, *mono_notes, *mask_notes, *_lens_notes(bent, cameras))
    for note in all_notes:
        log.info("%s: %s", path.name, note)
    return Recording(
        name=path.resolve().name,
        cameras=cameras,
        frames=frames,
        fps=fps,
        source=source,
        path=path,
        mono_kind=kind if any(monos.values()) else None,
        mono_emulated=emulated and any(monos.values()),
        notes=all_notes,
    )


def _lens_notes(bent: Mapping[str, Lens], cameras: Mapping[str, Camera]) -> tuple[str, ...]:
    if not bent:
        return ()
    shares = {name: black_share(lens, cameras[name]) for name, lens in bent.items()}
    worst = max(shares, key=lambda name: shares[name])
    refuse_black(shares[worst], worst)
    note = f"lens distortion of {', '.join(bent)} is undone when an image is read"
    if shares[worst] > BLACK_NOTED:
        note += f"; pixels that were not recorded are black: up to {shares[worst]:.1%} ({worst})"
    return (note,)


def _check_lens(lens: Lens, name: str, path: Path) -> None:
    numbers = np.array([*lens.K.ravel(), *lens.radial, *lens.tangential, *lens.denominator])
    coefficients = numbers[lens.K.size :]
    if not np.isfinite(numbers).all() or np.abs(coefficients).max(initial=0) > LARGEST_COEFFICIENT:
        raise D2Error(
            f"camera {name} of {path} has distortion coefficients {shown(coefficients.tolist())}, expected numbers of "
            f"at most {LARGEST_COEFFICIENT:g} in size: correct the calibration"
        )


def _maps(folder: Path, names: list[str], suffix: str) -> dict[str, FrameFiles]:
    return {name: numbered_files(folder / name, (suffix,)) for name in names if (folder / name).is_dir()}


def _mono_description(path: Path) -> tuple[MonoKind, bool, tuple[str, ...]]:
    """(kind, emulated, notes) of the maps in mono/."""
    declared = path / "mono" / "mono.json"
    content = read_json(declared, CORRECT) if declared.exists() else {}
    kind = content.get("kind", "relative")
    if "emulated" not in content:
        emulated, notes = _emulated_by_text(path)
    else:
        emulated, notes = content["emulated"], ("monocular maps are emulated, not predicted",)
    if not isinstance(kind, str) or kind not in get_args(MonoKind) or not isinstance(emulated, bool):
        raise D2Error(
            f"{declared} says kind {shown(kind)} and emulated {shown(emulated)}: "
            "expected 'relative' or 'metric', and true or false"
        )
    return cast(MonoKind, kind), emulated, notes if emulated else ()


def _emulated_by_text(path: Path) -> tuple[bool, tuple[str, ...]]:
    """Whether SOURCE.txt, or `mono` in cameras.json, says in words that the maps are emulated; and the note.

    Such maps must not pass for predictions because mono.json is missing.
    """
    for file, said in (("SOURCE.txt", _words_of_source(path)), ("cameras.json", _words_of_calibration(path))):
        if any(_EMULATED.search(words) for words in said):
            return True, (f"monocular maps are emulated, not predicted ({file} says so)",)
    return False, ()


_EMULATED = re.compile(r"(?<!\bnot )\bemulated\b", re.IGNORECASE)


def _words_of_source(path: Path) -> list[str]:
    """What follows the word `mono` in each line of SOURCE.txt."""
    source = path / "SOURCE.txt"
    text = read_bytes(source, REPLACE).decode(errors="replace") if source.is_file() else ""
    return re.findall(r"\bmono\b(.*)", text, re.IGNORECASE)


def _words_of_calibration(path: Path) -> list[str]:
    """`mono` in cameras.json, where there is such a file; a file of that name from another program counts as none."""
    try:
        said = read_json(path / "cameras.json").get("mono")
    except D2Error:
        return []
    return [said] if isinstance(said, str) else []


def _map(path: Path, key: str | None) -> np.ndarray:
    """A map float32 [h, w] from .npy, or from .npz under `key`; numbers beyond float32 become infinite."""
    stored = read_array(path, REPLACE, key=key)
    if stored.ndim != 2 or stored.size == 0:
        raise D2Error(f"{path} has shape {stored.shape}, expected [height, width]: {REPLACE}")
    with np.errstate(over="ignore"):
        return stored.astype(np.float32)

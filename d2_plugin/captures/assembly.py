"""A capture put together from picture files: what all readers of pictures on disk have in common.

Beside the pictures, whatever the layout, there may be depth/<camera>/<frame>.npz with true planar z under the key
"depth" (0 = unknown) and mono/<camera>/<frame>.npy with a monocular prediction: affine-invariant inverse depth, unless
mono/mono.json says otherwise with {"kind": "metric" | "relative", "emulated": bool}.
"""

from __future__ import annotations

import json
import logging
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from d2_plugin.captures.capture import Camera, Capture, MonoKind, Source
from d2_plugin.captures.files import FrameFiles, numbered_files
from d2_plugin.captures.lens import Lens, UndistortedSource, black_share
from d2_plugin.captures.pictures import read_picture
from d2_plugin.errors import D2Error

log = logging.getLogger(__name__)

BLACK_NOTED = 1e-3
"""Black share of an undistorted picture above which a note reports it."""


@dataclass(frozen=True)
class FolderSource:
    """Pictures and maps as files; every read opens one file."""

    images: dict[str, FrameFiles]
    depths: dict[str, FrameFiles]
    monos: dict[str, FrameFiles]

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        path = self.images[camera].get(frame)
        if path is None:
            raise D2Error(f"camera {camera} has no frame {frame}: choose one of the capture's frames")
        return read_picture(path)

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        """True planar z float32 [H, W], 0 where unknown, or None."""
        path = self.depths.get(camera, {}).get(frame)
        if path is None:
            return None
        depth = _load_array(path, "depth").astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        """Monocular map float32 [h, w] exactly as stored (holes and NaN included), or None."""
        path = self.monos.get(camera, {}).get(frame)
        return None if path is None else _load_array(path, None).astype(np.float32)


def assembled(
    path: Path,
    cameras: dict[str, Camera],
    images: Mapping[str, FrameFiles],
    frames: tuple[int, ...],
    fps: float,
    notes: Iterable[str] = (),
    lenses: Mapping[str, Lens] | None = None,
) -> Capture:
    """The capture of `cameras` (pinholes) whose pictures are `images`; every note is also logged.

    `lenses` describes the cameras whose recorded pictures are distorted; those are undistorted when read.
    """
    kind, emulated, mono_notes = _mono_description(path)
    monos = _maps(path / "mono", list(cameras), ".npy")
    source: Source = FolderSource(dict(images), _maps(path / "depth", list(cameras), ".npz"), monos)
    bent = {name: lens for name, lens in (lenses or {}).items() if name in cameras and lens.bends}
    if bent:
        source = UndistortedSource(source, bent, {name: (cameras[name].width, cameras[name].height) for name in bent})
    all_notes = (*notes, *mono_notes, *_lens_notes(bent, cameras))
    for note in all_notes:
        log.info("%s: %s", path.name, note)
    return Capture(
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
    note = f"lens distortion of {', '.join(bent)} is undone when a picture is read"
    if shares[worst] > BLACK_NOTED:
        note += f"; pixels that were not recorded are black: up to {shares[worst]:.1%} ({worst})"
    return (note,)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file, or one sentence that says what is wrong with it."""
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as failure:
        raise D2Error(f"{path} is not JSON ({failure}): correct the file") from None
    if not isinstance(content, dict):
        raise D2Error(f"{path} holds a {type(content).__name__}, expected an object: see docs/captures.md")
    return content


def _maps(folder: Path, names: list[str], suffix: str) -> dict[str, FrameFiles]:
    return {name: numbered_files(folder / name, (suffix,)) for name in names if (folder / name).is_dir()}


def _mono_description(path: Path) -> tuple[MonoKind, bool, tuple[str, ...]]:
    """(kind, emulated, notes) of the maps in mono/."""
    declared = path / "mono" / "mono.json"
    content = read_json(declared) if declared.exists() else {}
    kind = content.get("kind", "relative")
    if "emulated" not in content:
        emulated, notes = _emulated_by_text(path)
    else:
        emulated, notes = content["emulated"], ("monocular maps are emulated, not predicted",)
    if kind not in get_args(MonoKind) or not isinstance(emulated, bool):
        raise D2Error(
            f"{declared} says kind {kind!r} and emulated {emulated!r}: "
            "expected 'relative' or 'metric', and true or false"
        )
    return kind, emulated, notes if emulated else ()


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
    text = source.read_text(errors="replace") if source.is_file() else ""
    return re.findall(r"\bmono\b(.*)", text, re.IGNORECASE)


def _words_of_calibration(path: Path) -> list[str]:
    """`mono` in cameras.json, where there is such a file; a file of that name from another program counts as none."""
    try:
        content = json.loads((path / "cameras.json").read_text())
    except (OSError, ValueError):
        return []
    said = content.get("mono") if isinstance(content, dict) else None
    return [said] if isinstance(said, str) else []


def _load_array(path: Path, key: str | None) -> np.ndarray:
    """A 2D array from .npy, or from .npz under `key`."""
    try:
        with open(path, "rb") as file:  # np.load leaves a damaged file open
            loaded = np.load(file)
            array = loaded if key is None else loaded[key]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as failure:
        raise D2Error(f"cannot read {path} ({failure}): replace the file or remove it") from None
    if array.ndim != 2:
        raise D2Error(f"{path} has shape {array.shape}, expected [height, width]: write one number per pixel")
    return array

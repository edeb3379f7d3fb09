"""A recording put together from image files: what all readers of images on disk have in common.

Beside the images, whatever the layout, there may be depth/<camera>/<frame>.npz with true planar z under the key
"depth" (0 = unknown) and mono/<camera>/<frame>.npy with a monocular prediction: affine-invariant inverse depth, unless
mono/mono.json says otherwise with {"kind": "metric" | "relative", "emulated": bool}. Masks: see `masks`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.reading import field, read_json
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.undistort import UndistortedSource, refuse_black
from d2_plugin.recordings.files import FrameFiles, files_by_camera
from d2_plugin.recordings.images import MASK_FOLDERS, VALID_FOLDER, read_image, read_mask
from d2_plugin.recordings.recording import MonoKind, Recording, Source

log = logging.getLogger(__name__)

BLACK_NOTED = 1e-3  # black share of an undistorted image above which a note reports it

CORRECT = "correct the file, see docs/recordings.md"
REPLACE = "replace the file or remove it"


@dataclass(frozen=True)
class FolderSource(Source):
    """Images, maps and masks as files by camera; every read opens one file."""

    images: Mapping[str, FrameFiles]
    depths: Mapping[str, FrameFiles]
    monos: Mapping[str, FrameFiles]
    masks: Mapping[str, FrameFiles]
    valid: Mapping[str, Path]

    def image(self, camera: str, frame: int) -> np.ndarray:
        path = self.images[camera].get(frame)
        if path is None:
            raise D2Error(f"camera {camera} has no frame {frame}: choose one of the recording's frames")
        return read_image(path)

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        path = self.depths.get(camera, {}).get(frame)
        if path is None:
            return None
        depth = _map(path, "depth")
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        path = self.monos.get(camera, {}).get(frame)
        return None if path is None else _map(path, None)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        path = self.masks.get(camera, {}).get(frame)
        return None if path is None else read_mask(path)

    def recorded(self, camera: str) -> np.ndarray | None:
        path = self.valid.get(camera)
        return None if path is None else read_mask(path) > 0.5


def assembled(
    path: Path,
    cameras: Mapping[str, CalibratedCamera],
    images: Mapping[str, FrameFiles],
    frames: tuple[int, ...],
    fps: float,
    where: str,
    notes: Iterable[str] = (),
) -> Recording:
    """The recording of `cameras`, in the size of their images, whose files are `images`; every note is also logged.

    `where` names the file that describes the cameras. Images of cameras with a distortion are undistorted when read.
    """
    pinholes = {name: camera.pinhole(where) for name, camera in cameras.items()}
    kind, emulated = _mono_description(path)
    monos = files_by_camera(path / "mono", cameras, (".npy",))
    masks, mask_notes = _masks(path, cameras)
    valid = {name: path / VALID_FOLDER / f"{name}.png" for name in cameras}
    valid = {name: file for name, file in valid.items() if file.is_file()}
    depths = files_by_camera(path / "depth", cameras, (".npz",))
    source: Source = FolderSource(images, depths, monos, masks, valid)
    bent = {name: camera for name, camera in cameras.items() if camera.lens.bends}
    if bent:
        source = UndistortedSource(source, bent)
    all_notes = (*notes, *mask_notes, *_mono_notes(path / "mono", monos), *_lens_notes(bent))
    for note in all_notes:
        log.info("%s: %s", path.name, note)
    return Recording(
        name=path.resolve().name,
        cameras=pinholes,
        frames=frames,
        fps=fps,
        source=source,
        path=path,
        mono_kind=kind if any(monos.values()) else None,
        mono_emulated=emulated and any(monos.values()),
        notes=all_notes,
    )


def _lens_notes(bent: Mapping[str, CalibratedCamera]) -> tuple[str, ...]:
    if not bent:
        return ()
    shares = {name: refuse_black(camera) for name, camera in bent.items()}
    worst = max(shares, key=lambda name: shares[name])
    note = f"lens distortion of {', '.join(bent)} is undone when an image is read"
    if shares[worst] > BLACK_NOTED:
        note += f"; pixels that were not recorded are black: up to {shares[worst]:.1%} ({worst})"
    return (note,)


def _masks(path: Path, names: Iterable[str]) -> tuple[dict[str, FrameFiles], tuple[str, ...]]:
    """(foreground masks that lie beside the images, a note that says which)."""
    for folder in MASK_FOLDERS:
        masks = {name: files for name, files in files_by_camera(path / folder, names).items() if files}
        if masks:
            some = "" if masks.keys() == set(names) else f" of {', '.join(masks)}"
            return masks, (f"foreground masks{some} from {folder}",)
    return {}, ()


def _mono_description(path: Path) -> tuple[MonoKind, bool]:
    declared = path / "mono" / "mono.json"
    content = read_json(declared, CORRECT) if declared.exists() else {}
    kind: MonoKind = field(content, "kind", MonoKind, str(declared), CORRECT, default="relative")
    return kind, field(content, "emulated", bool, str(declared), CORRECT, default=False)


def _mono_notes(folder: Path, monos: Mapping[str, FrameFiles]) -> tuple[str, ...]:
    """A word about maps that are no arrays, or lie elsewhere: a run without them looks like one that used them."""
    if any(monos.values()) or not folder.is_dir() or all(entry.name == "mono.json" for entry in folder.iterdir()):
        return ()
    return ("nothing in mono/ is used: a map is an array of numbers [height, width] in mono/CAMERA/FRAME.npy",)


def _map(path: Path, key: str | None) -> np.ndarray:
    """A map float32 [h, w] from .npy, or from .npz under `key`; numbers beyond float32 become infinite."""
    stored = read_array(path, REPLACE, key=key)
    if stored.ndim != 2 or stored.size == 0:
        raise D2Error(f"{path} has shape {stored.shape}, expected [height, width]: {REPLACE}")
    with np.errstate(over="ignore"):
        return stored.astype(np.float32)

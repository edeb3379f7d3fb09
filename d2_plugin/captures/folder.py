"""The folder layout: images/<camera>/<frame>.(png|jpg), cameras.json and, optionally, depth/ and mono/ maps.

`cameras.json` holds {"fps", "cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy", "R", "t"}], "bounds":
{camera: [near, far]}} with OpenCV axes, x_cam = R X + t and the centre of pixel i at i + 0.5.
depth/<camera>/<frame>.npz holds true planar z under the key "depth" (0 = unknown). mono/<camera>/<frame>.npy holds a
monocular prediction: affine-invariant inverse depth, unless mono/mono.json says otherwise with
{"kind": "metric" | "relative", "emulated": bool}.
"""

from __future__ import annotations

import json
import logging
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from d2_plugin.captures.calibration import checked_camera, pinhole, rigid
from d2_plugin.captures.capture import Camera, Capture, MonoKind
from d2_plugin.captures.files import FrameFiles, common_frames, numbered_files
from d2_plugin.captures.pictures import picture_size, read_picture
from d2_plugin.errors import D2Error, unknown_name

log = logging.getLogger(__name__)

DEFAULT_FPS = 30.0
"""Frame rate taken, and noted, where cameras.json names none."""


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
        """Monocular map float32 [h, w] exactly as stored (its holes and NaN are the reader's to judge), or None."""
        path = self.monos.get(camera, {}).get(frame)
        return None if path is None else _load_array(path, None).astype(np.float32)


def open_folder(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Capture:
    """Read the folder layout; nothing but headers is opened.

    `cameras` restricts everything, checks included, to the named ones; `intersect` leaves out, with a note, cameras
    that have pictures without calibration or calibration without pictures, which are otherwise refused by name.
    """
    description = _read_json(path / "cameras.json")
    calibrated = _calibrations(description, path / "cameras.json")
    pictured = {folder.name: folder for folder in sorted((path / "images").iterdir()) if folder.is_dir()}
    names, notes = _agreed(list(calibrated), list(pictured), cameras, intersect, path)
    images = {name: numbered_files(pictured[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    for name in names:
        _check_size(calibrated[name], images[name][frames[0]])
    kind, emulated, mono_notes = _mono_description(path)
    source = FolderSource(images, _maps(path / "depth", names, ".npz"), _maps(path / "mono", names, ".npy"))
    fps, fps_notes = _frame_rate(description, path, len(frames))
    all_notes = (*notes, *frame_notes, *mono_notes, *fps_notes)
    for note in all_notes:
        log.info("%s: %s", path.name, note)
    return Capture(
        name=path.resolve().name,
        cameras={name: calibrated[name] for name in names},
        frames=frames,
        fps=fps,
        source=source,
        path=path,
        mono_kind=kind if any(source.monos.values()) else None,
        mono_emulated=emulated and any(source.monos.values()),
        notes=all_notes,
    )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as failure:
        raise D2Error(f"{path} is not JSON ({failure}): correct the file") from None
    if not isinstance(content, dict):
        raise D2Error(f"{path} holds a {type(content).__name__}, expected an object: see the folder layout")
    return content


def _calibrations(description: dict[str, Any], path: Path) -> dict[str, Camera]:
    entries = description.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise D2Error(f"{path} has no list 'cameras': write one entry per camera")
    bounds = description.get("bounds", {})
    found: dict[str, Camera] = {}
    for entry in entries:
        camera = _calibration(entry, bounds, path)
        if camera.name in found:
            raise D2Error(f"{path} describes camera {camera.name} twice: remove one entry")
        found[camera.name] = camera
    return found


def _calibration(entry: dict[str, Any], bounds: dict[str, Any], path: Path) -> Camera:
    try:
        name = str(entry["name"])
        K = pinhole(*(float(entry[key]) for key in ("fx", "fy", "cx", "cy")))
        rotation = np.array(entry["R"], np.float64).reshape(3, 3)
        T = rigid(rotation, np.array(entry["t"], np.float64).reshape(3))
        size = (int(entry["width"]), int(entry["height"]))
        near_far = (float(bounds[name][0]), float(bounds[name][1])) if name in bounds else None
    except KeyError as missing:
        label = entry.get("name", "without a name") if isinstance(entry, dict) else entry
        raise D2Error(f"camera {label} in {path} has no {missing}: add the number") from None
    except (TypeError, ValueError, IndexError) as failure:
        raise D2Error(f"a camera in {path} cannot be understood ({failure}): see the folder layout") from None
    return checked_camera(name, size, K, T, near_far, str(path))


def _agreed(
    calibrated: list[str], pictured: list[str], asked: tuple[str, ...] | None, intersect: bool, path: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras to read, notes), or a refusal that names what does not fit."""
    wanted = calibrated + [name for name in pictured if name not in calibrated] if asked is None else list(asked)
    for name in wanted:
        if name not in calibrated and name not in pictured:
            raise unknown_name("camera", name, {*calibrated, *pictured})
    no_calibration = [name for name in wanted if name not in calibrated]
    no_pictures = [name for name in wanted if name not in pictured]
    both = [name for name in wanted if name in calibrated and name in pictured]
    if both and intersect and (no_calibration or no_pictures):
        return both, (f"left out, calibration or pictures missing: {', '.join({*no_calibration, *no_pictures})}",)
    if no_calibration:
        raise D2Error(
            f"camera {', '.join(no_calibration)} is not in {path / 'cameras.json'}, which has {', '.join(calibrated)}: "
            "add its calibration or choose the cameras to read"
        )
    if no_pictures:
        raise D2Error(
            f"camera {', '.join(no_pictures)} of {path / 'cameras.json'} has no folder in {path / 'images'}: "
            "add its pictures or choose the cameras to read"
        )
    return both, ()


def _check_size(camera: Camera, first: Path) -> None:
    width, height = picture_size(first)
    if (width, height) != (camera.width, camera.height):
        raise D2Error(
            f"{first} is {width}x{height} pixels but cameras.json says {camera.width}x{camera.height} for camera "
            f"{camera.name}: resize the pictures or correct the calibration"
        )


def _maps(folder: Path, names: list[str], suffix: str) -> dict[str, FrameFiles]:
    return {name: numbered_files(folder / name, (suffix,)) for name in names if (folder / name).is_dir()}


def _mono_description(path: Path) -> tuple[MonoKind, bool, tuple[str, ...]]:
    """(kind, emulated, notes) of the maps in mono/."""
    declared = path / "mono" / "mono.json"
    if not declared.exists():
        return "relative", *_emulated_by_source(path)
    content = _read_json(declared)
    kind, emulated = content.get("kind", "relative"), content.get("emulated", False)
    if kind not in get_args(MonoKind) or not isinstance(emulated, bool):
        raise D2Error(
            f"{declared} says kind {kind!r} and emulated {emulated!r}: "
            "expected 'relative' or 'metric', and true or false"
        )
    return kind, emulated, ("monocular maps are emulated, not predicted",) if emulated else ()


def _emulated_by_source(path: Path) -> tuple[bool, tuple[str, ...]]:
    """Captures without mono.json that own up to emulated maps in their SOURCE.txt must not pass for predictions."""
    source = path / "SOURCE.txt"
    text = source.read_text(errors="replace") if source.exists() else ""
    if re.search(r"\bmono\b[^\n]*\bEMULATED\b", text, re.IGNORECASE) is None:
        return False, ()
    return True, ("monocular maps are emulated, not predicted (SOURCE.txt says so)",)


def _frame_rate(description: dict[str, Any], path: Path, frames: int) -> tuple[float, tuple[str, ...]]:
    if "fps" not in description:
        return DEFAULT_FPS, (f"cameras.json names no fps: {DEFAULT_FPS:g} taken",) if frames > 1 else ()
    fps = description["fps"]
    if not isinstance(fps, int | float) or not 0 < fps < float("inf"):
        raise D2Error(f"{path / 'cameras.json'} says fps {fps!r}, expected frames per second above 0: correct it")
    return float(fps), ()


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

"""The folder layout: images/<camera>/<frame>.(png|jpg), cameras.json and, optionally, depth/ and mono/ maps.

`cameras.json` holds {"fps", "cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy", "R", "t"}], "bounds":
{camera: [near, far]}} with OpenCV axes, x_cam = R X + t and the centre of pixel i at i + 0.5.
depth/<camera>/<frame>.npz holds true planar z under the key "depth" (0 = unknown). mono/<camera>/<frame>.npy holds a
monocular prediction: affine-invariant inverse depth, unless mono/mono.json says otherwise with
{"kind": "metric" | "relative", "emulated": bool}.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional, Union

import numpy as np

from d2_plugin.captures.assembly import CORRECT, assembled
from d2_plugin.captures.calibration import LARGEST_NUMBER, checked_camera, checked_rate, pinhole, rigid
from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.files import common_frames, numbered_files
from d2_plugin.captures.pictures import picture_size
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import field, read_json, said
from d2_plugin.values import Range, shown

CALIBRATION = "cameras.json"

DEFAULT_FPS = 30.0
"""Frame rate that is assumed, with a note, where cameras.json names none."""


def is_folder(path: Path) -> bool:
    """Whether `path` looks like the folder layout."""
    return (path / CALIBRATION).is_file() and (path / "images").is_dir()


def open_folder(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Capture:
    """Read the folder layout; nothing but headers is opened.

    `cameras` restricts everything, checks included, to the named ones; `intersect` leaves out, with a note, cameras
    that have pictures without calibration or calibration without pictures, which are otherwise refused by name.
    """
    description = read_json(path / CALIBRATION, CORRECT)
    calibrated = _calibrations(description, path / CALIBRATION)
    pictured = {folder.name: folder for folder in sorted((path / "images").iterdir()) if folder.is_dir()}
    names, notes = _agreed(list(calibrated), list(pictured), cameras, intersect, path)
    images = {name: numbered_files(pictured[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    for name in names:
        _check_size(calibrated[name], images[name][frames[0]])
    fps, fps_notes = _frame_rate(description, path, len(frames))
    return assembled(
        path, {name: calibrated[name] for name in names}, images, frames, fps, (*notes, *frame_notes, *fps_notes)
    )


def _calibrations(description: dict[str, Any], path: Path) -> dict[str, Camera]:
    entries = description.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise D2Error(f"{path} has no list 'cameras': write one entry per camera")
    bounds = field(description, "bounds", dict, str(path), CORRECT, default={})
    found: dict[str, Camera] = {}
    for entry in entries:
        camera = _calibration(entry, bounds, path)
        if camera.name in found:
            raise D2Error(f"{path} describes camera {camera.name} twice: remove one entry")
        found[camera.name] = camera
    return found


def _calibration(entry: Any, bounds: dict[str, Any], path: Path) -> Camera:
    if not isinstance(entry, dict):
        raise D2Error(f"a camera in {path} cannot be understood ({shown(entry)} is no object): {CORRECT}")
    name = str(field(entry, "name", Union[str, int], f"a camera in {path}", CORRECT))  # noqa: UP007
    where = f"camera {name} in {path}"
    K = pinhole(*(field(entry, key, _NUMBER, where, CORRECT) for key in ("fx", "fy", "cx", "cy")))
    T = rigid(_numbers(entry, "R", (3, 3), where), _numbers(entry, "t", (3,), where))
    size = (field(entry, "width", int, where, CORRECT), field(entry, "height", int, where, CORRECT))
    pair = Optional[tuple[_NUMBER, _NUMBER]]  # noqa: UP045  at run time, on Python 3.9 too
    near_far = field(bounds, name, pair, f"bounds in {path}", CORRECT, default=None)
    return checked_camera(name, size, K, T, near_far, str(path))


_NUMBER = Annotated[float, Range(-LARGEST_NUMBER, LARGEST_NUMBER)]


def _numbers(entry: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """An array of a given shape, nested in lists or not."""
    value = field(entry, key, list, where, CORRECT)
    try:
        array = np.array(value, np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError) as failure:
        raise D2Error(f"{where} cannot be understood ({key}: {said(failure)}): {CORRECT}") from None
    if not np.abs(array).max() <= LARGEST_NUMBER:
        raise D2Error(f"{key} of {where} has a number that is not finite or too large: {CORRECT}")
    return array


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
        return both, (f"left out, calibration or pictures missing: {', '.join([*no_calibration, *no_pictures])}",)
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


def _frame_rate(description: dict[str, Any], path: Path, frames: int) -> tuple[float, tuple[str, ...]]:
    if "fps" not in description:
        return DEFAULT_FPS, (f"cameras.json names no fps: {DEFAULT_FPS:g} taken",) if frames > 1 else ()
    where = str(path / CALIBRATION)
    return checked_rate(field(description, "fps", float, where, CORRECT), where), ()

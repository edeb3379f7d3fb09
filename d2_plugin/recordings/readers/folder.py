"""The folder layout: images/<camera>/<frame>.(png|jpg), cameras.json and, optionally, depth/ and mono/ maps.

`cameras.json` holds {"fps", "cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy", "R", "t"}], "bounds":
{camera: [near, far]}} with OpenCV axes, x_cam = R X + t and the centre of pixel i at i + 0.5. Where a camera has a
`model` and its `distortion` as well (see d2_plugin.recordings.cameras.formats), its images are undistorted when read.
depth/<camera>/<frame>.npz holds true planar z under the key "depth" (0 = unknown). mono/<camera>/<frame>.npy holds a
monocular prediction: affine-invariant inverse depth, unless mono/mono.json says otherwise with
{"kind": "metric" | "relative", "emulated": bool}.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import field, read_json
from d2_plugin.recordings.assembly import CORRECT, assembled
from d2_plugin.recordings.cameras.calibration import checked_rate
from d2_plugin.recordings.cameras.formats.cameras_json import read_entry
from d2_plugin.recordings.cameras.formats.document import NUMBER
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.files import common_frames, numbered_files
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.readers.measured import with_measured
from d2_plugin.recordings.recording import Camera, Recording

CALIBRATION = "cameras.json"

DEFAULT_FPS = 30.0
"""Frame rate that is assumed, with a note, where cameras.json names none."""


def is_folder(path: Path) -> bool:
    """Whether `path` looks like the folder layout."""
    return (path / CALIBRATION).is_file() and (path / "images").is_dir()


def open_folder(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the folder layout; nothing but headers is opened.

    `cameras` restricts everything, checks included, to the named ones; `intersect` leaves out, with a note, cameras
    that have images without calibration or calibration without images, which are otherwise refused by name.
    """
    description = read_json(path / CALIBRATION, CORRECT)
    calibrated = _calibrations(description, path / CALIBRATION)
    pictured = {folder.name: folder for folder in sorted((path / "images").iterdir()) if folder.is_dir()}
    names, notes = _agreed(list(calibrated), list(pictured), cameras, intersect, path)
    images = {name: numbered_files(pictured[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    for name in names:
        _check_size(calibrated[name][0], images[name][frames[0]])
    fps, fps_notes = _frame_rate(description, path, len(frames))
    pinholes = {name: calibrated[name][0] for name in names}
    lenses = {name: calibrated[name][1] for name in names}
    recording = assembled(path, pinholes, images, frames, fps, (*notes, *frame_notes, *fps_notes), lenses)
    return with_measured(recording, description, str(path / CALIBRATION))


def _calibrations(description: dict[str, Any], path: Path) -> dict[str, tuple[Camera, Lens]]:
    entries = description.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise D2Error(f"{path} has no list 'cameras': write one entry per camera")
    bounds = field(description, "bounds", dict, str(path), CORRECT, default={})
    found: dict[str, tuple[Camera, Lens]] = {}
    for entry in entries:
        camera, lens = _calibration(entry, bounds, path)
        if camera.name in found:
            raise D2Error(f"{path} describes camera {camera.name} twice: remove one entry")
        found[camera.name] = (camera, lens)
    return found


def _calibration(entry: Any, bounds: dict[str, Any], path: Path) -> tuple[Camera, Lens]:
    """The pinhole camera of the undistorted images, and the lens of the recorded ones."""
    camera = read_entry(entry, str(path)).recorded(None, str(path))
    pair = Optional[tuple[NUMBER, NUMBER]]  # noqa: UP045  at run time, on Python 3.9 too
    near_far = field(bounds, camera.name, pair, f"bounds in {path}", CORRECT, default=None)
    return camera.pinhole(str(path), near_far), camera.lens


def _agreed(
    calibrated: list[str], pictured: list[str], asked: tuple[str, ...] | None, intersect: bool, path: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras to read, notes), or a refusal that names what does not fit."""
    wanted = calibrated + [name for name in pictured if name not in calibrated] if asked is None else list(asked)
    for name in wanted:
        if name not in calibrated and name not in pictured:
            raise unknown_name("camera", name, {*calibrated, *pictured})
    no_calibration = [name for name in wanted if name not in calibrated]
    no_images = [name for name in wanted if name not in pictured]
    both = [name for name in wanted if name in calibrated and name in pictured]
    if both and intersect and (no_calibration or no_images):
        return both, (f"left out, calibration or images missing: {', '.join([*no_calibration, *no_images])}",)
    if no_calibration:
        raise D2Error(
            f"camera {', '.join(no_calibration)} is not in {path / 'cameras.json'}, which has {', '.join(calibrated)}: "
            "add its calibration or choose the cameras to read"
        )
    if no_images:
        raise D2Error(
            f"camera {', '.join(no_images)} of {path / 'cameras.json'} has no folder in {path / 'images'}: "
            "add its images or choose the cameras to read"
        )
    return both, ()


def _check_size(camera: Camera, first: Path) -> None:
    width, height = image_size(first)
    if (width, height) != (camera.width, camera.height):
        raise D2Error(
            f"{first} is {width}x{height} pixels but cameras.json says {camera.width}x{camera.height} for camera "
            f"{camera.name}: resize the images or correct the calibration"
        )


def _frame_rate(description: dict[str, Any], path: Path, frames: int) -> tuple[float, tuple[str, ...]]:
    if "fps" not in description:
        return DEFAULT_FPS, (f"cameras.json names no fps: {DEFAULT_FPS:g} taken",) if frames > 1 else ()
    where = str(path / CALIBRATION)
    return checked_rate(field(description, "fps", float, where, CORRECT), where), ()

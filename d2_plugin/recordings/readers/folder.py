"""The folder layout: images/<camera>/<frame>.(png|jpg), cameras.json and, optionally, depth/ and mono/ maps.

The cameras are described in `d2_plugin.recordings.cameras.formats.cameras_json`; beside them cameras.json may hold

    "fps", "bounds": {camera: [near, far]}
    "exposures": {camera: {"gain": [r, g, b], "error": [r, g, b]}}    measured when videos were imported
    "late": {camera: {frame: seconds}}                                cameras that did not expose together

Maps: see `d2_plugin.recordings.assembly`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from d2_plugin.errors import D2Error
from d2_plugin.reading import field, read_json
from d2_plugin.recordings.assembly import CORRECT, assembled
from d2_plugin.recordings.cameras.camera import CalibratedCamera, checked_rate
from d2_plugin.recordings.cameras.formats.cameras_json import read_camera
from d2_plugin.recordings.files import camera_folders, cameras_with_images, common_frames, frame_number, numbered_files
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.recording import Exposure, Recording
from d2_plugin.values import MOST, Range

CALIBRATION = "cameras.json"

DEFAULT_FPS = 30.0  # frame rate that is assumed, with a note, where cameras.json names none

GAIN = Annotated[float, Range(1e-3, 1e3)]
ERROR = Annotated[float, Range(0, 1e3)]
LATE = Annotated[float, Range(-MOST, MOST)]


def is_folder(path: Path) -> bool:
    """Whether `path` looks like the folder layout."""
    return (path / CALIBRATION).is_file() and (path / "images").is_dir()


def open_folder(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the folder layout; nothing but headers is opened.

    `cameras` restricts everything, checks included, to the named ones; `intersect` leaves out, with a note, cameras
    that have images without calibration or calibration without images, which are otherwise refused by name.
    """
    where = str(path / CALIBRATION)
    description = read_json(path / CALIBRATION, CORRECT)
    calibrated = _calibrated(description, where)
    pictured = camera_folders(path / "images")
    names, notes = cameras_with_images(calibrated, pictured, cameras, intersect, path / CALIBRATION)
    images = {name: numbered_files(pictured[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    for name in names:
        _check_size(calibrated[name], images[name][frames[0]])
    fps, fps_notes = DEFAULT_FPS, (f"cameras.json names no fps: {DEFAULT_FPS:g} taken",) if len(frames) > 1 else ()
    if "fps" in description:
        fps, fps_notes = checked_rate(field(description, "fps", float, where, CORRECT), where), ()
    for table in ("bounds", "exposures", "late"):
        unknown = sorted(field(description, table, dict, where, CORRECT, default={}).keys() - calibrated.keys())
        notes += (f"{table} of {', '.join(unknown)} in cameras.json are of no camera there",) if unknown else ()
    chosen = {name: calibrated[name] for name in names}
    recording = assembled(path, chosen, images, frames, fps, where, (*notes, *frame_notes, *fps_notes))
    return with_measured(recording, description, where)


def _calibrated(description: Mapping[str, Any], where: str) -> dict[str, CalibratedCamera]:
    entries = description.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise D2Error(f"{where} has no list 'cameras': write one entry per camera")
    bounds = field(description, "bounds", dict, where, CORRECT, default={})
    cameras: dict[str, CalibratedCamera] = {}
    for entry in entries:
        camera = read_camera(entry, where, bounds)
        camera.pinhole(where)
        if camera.name in cameras:
            raise D2Error(f"{where} describes camera {camera.name} twice: remove one entry")
        cameras[camera.name] = camera
    return cameras


def _check_size(camera: CalibratedCamera, first: Path) -> None:
    width, height = image_size(first)
    if (width, height) != camera.size:
        raise D2Error(
            f"{first} is {width}x{height} pixels but cameras.json says {camera.width}x{camera.height} for camera "
            f"{camera.name}: resize the images or correct the calibration"
        )


def with_measured(recording: Recording, description: Mapping[str, Any], where: str) -> Recording:
    """The recording with the exposures and the lateness of its cameras, where the file has them."""
    exposures, late = (field(description, key, dict, where, CORRECT, default={}) for key in ("exposures", "late"))
    return replace(
        recording,
        exposures={name: _exposure(exposures, name, where) for name in recording.cameras if name in exposures},
        late={name: _late(late, name, recording.frames, where) for name in recording.cameras if name in late},
    )


def _exposure(table: Mapping[str, Any], name: str, where: str) -> Exposure:
    place = f"exposures of camera {name} in {where}"
    entry = field(table, name, dict, f"exposures in {where}", CORRECT)
    gain = field(entry, "gain", tuple[GAIN, GAIN, GAIN], place, CORRECT)
    return Exposure(gain, field(entry, "error", tuple[ERROR, ERROR, ERROR], place, CORRECT))


def _late(table: Mapping[str, Any], name: str, frames: tuple[int, ...], where: str) -> dict[int, float]:
    place, wanted = f"late of camera {name} in {where}", set(frames)
    entry = field(table, name, dict, f"late in {where}", CORRECT)
    numbers = {key: frame_number(key, f"{place}: {key}") for key in entry if str(key).isdecimal()}
    return {number: field(entry, key, LATE, place, CORRECT) for key, number in numbers.items() if number in wanted}

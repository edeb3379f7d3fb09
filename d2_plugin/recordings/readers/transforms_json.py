"""Blender's and Instant-NGP's transforms.json: a list of images, each with its pose, time and intrinsics.

`transform_matrix` maps camera to world with OpenGL axes (x right, y up, z backward). `time` is in any unit: seconds in
converted multi-view recordings, 0 to 1 in D-NeRF's scenes. Images of one pose are the frames of one camera; a file
without times from many poses is one instant. Intrinsics may stand at the top or beside each image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import field, read_json, said
from d2_plugin.recordings.assembly import CORRECT, assembled
from d2_plugin.recordings.cameras.calibration import LARGEST_NUMBER, check_name, checked_rate
from d2_plugin.recordings.cameras.formats.transforms import read_entry
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.files import common_frames
from d2_plugin.recordings.images import IMAGE_SUFFIXES, image_size
from d2_plugin.recordings.naming import Shot, arrange, by_camera
from d2_plugin.recordings.recording import Camera, Recording

FILES = ("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json")
"""All that are there are read; their images are joined."""

STATIC_FPS = 30.0
"""Frame rate of files without times, where it means nothing."""

SAME_POSE = 1e-5
"""Largest difference of the matrices of one camera; these files are converted, not estimated per image."""

TIME_DIGITS = 12
"""Decimals of a time that count: splits are written by programs that divide in another order."""


@dataclass(frozen=True, eq=False)
class _Entry:
    """One image as a file lists it."""

    name: str  # path without the leading ./, with a suffix
    file: Path
    matrix: np.ndarray  # [4, 4] camera to world, OpenGL axes
    time: float | None
    intrinsics: Mapping[str, Any]
    listed_in: Path


def is_transforms(path: Path) -> bool:
    """Whether `path` holds a transforms.json or one of its parts."""
    return any((path / name).is_file() for name in FILES)


def open_transforms(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read transforms.json, or transforms_train.json with its companions; only headers of images are opened.

    Missing images are refused by name, or left out with a note where `intersect`.

    Raises:
        D2Error: among others for a camera that moves over time: the cameras of a `Recording` stand still.
    """
    entries, notes = _present(_entries(path), intersect)
    shots, fps = _shots(entries, path)
    files = by_camera(shots, {name: entry.file for name, entry in entries.items()})
    for name in cameras or ():
        if name not in files:
            raise unknown_name("camera", name, files)
    images = {name: files[name] for name in (cameras or files)}
    frames, frame_notes = common_frames(images, path)
    first = {shot.camera: entries[name] for name, shot in shots.items() if shot.frame == frames[0]}
    calibrated = {name: _camera(name, first[name]) for name in images}
    return assembled(
        path,
        {name: camera for name, (camera, _) in calibrated.items()},
        images,
        frames,
        fps,
        (*notes, *_split_notes(entries, shots), *frame_notes),
        {name: lens for name, (_, lens) in calibrated.items()},
    )


def _entries(path: Path) -> dict[str, _Entry]:
    found: dict[str, _Entry] = {}
    for listed_in in (path / name for name in FILES if (path / name).is_file()):
        content = read_json(listed_in, CORRECT)
        frames = content.get("frames")
        if not isinstance(frames, list):
            raise D2Error(f"{listed_in} has no list 'frames': write one entry per image")
        common = {key: value for key, value in content.items() if key != "frames"}
        for frame in frames:
            entry = _entry(frame, common, listed_in)
            found.setdefault(entry.name, entry)  # an image that several files list counts once
    if not found:
        raise D2Error(f"{path} has no transforms.json or transforms_train.json that lists images: give one that does")
    return found


def _entry(frame: Any, common: Mapping[str, Any], listed_in: Path) -> _Entry:
    try:
        name = str(frame["file_path"])
        matrix = np.array(frame["transform_matrix"], np.float64)
        matrix = np.vstack([matrix, [0, 0, 0, 1]]) if matrix.shape == (3, 4) else matrix.reshape(4, 4)
        time = round(float(frame["time"]), TIME_DIGITS) if "time" in frame else None
        file = _image_file(listed_in.parent / name)
    except KeyError as missing:
        raise D2Error(f"an image in {listed_in} has no {missing}: add it") from None
    except (TypeError, ValueError, OverflowError) as failure:
        raise D2Error(f"an image in {listed_in} cannot be understood ({said(failure)}): {CORRECT}") from None
    if not np.isfinite(matrix).all() or (time is not None and not math.isfinite(time)):
        raise D2Error(f"{name} in {listed_in} has a number that is not finite: correct the file")
    if np.abs(matrix).max() > LARGEST_NUMBER:
        raise D2Error(f"{name} in {listed_in} has a matrix with {np.abs(matrix).max():g} in it: correct the file")
    return _Entry(name.removeprefix("./"), file, matrix, time, {**common, **frame}, listed_in)


def _image_file(path: Path) -> Path:
    """The file itself, or the one with a suffix where the list leaves it out."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return path
    candidates = [path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES]
    return next((file for file in candidates if file.is_file()), candidates[0])


def _present(entries: dict[str, _Entry], intersect: bool) -> tuple[dict[str, _Entry], tuple[str, ...]]:
    present = {name: entry for name, entry in entries.items() if entry.file.is_file()}
    missing = [entry for name, entry in entries.items() if name not in present]
    if missing and (not present or not intersect):
        raise D2Error(
            f"{missing[0].file} is listed in {missing[0].listed_in} but is not there ({len(missing)} of {len(entries)} "
            "images are missing): add the images or remove them from the list"
        )
    return present, (f"{len(missing)} listed images are missing and left out",) if missing else ()


def _shots(entries: dict[str, _Entry], path: Path) -> tuple[dict[str, Shot], float]:
    """Camera and frame of every image, and frames per unit of time."""
    declared = _rate(next(iter(entries.values())), path)
    shots, _ = arrange(entries, lambda group: _still([entries[name] for name in group]))
    times = {name: entry.time for name, entry in entries.items() if entry.time is not None}
    instants = set(times.values())
    if not instants or (len(instants) == 1 and len(times) == len(entries)):
        return shots, declared or STATIC_FPS
    if len(times) < len(entries):
        raise D2Error(f"some images listed in {path} have a time and others have none: give all of them one")
    if all(shot.frame == 0 for shot in shots.values()):
        raise D2Error(
            f"{len(entries)} images listed in {path} were taken at {len(instants)} times by cameras that move or "
            "have no number in their names: expected cameras that stand still, and names like CAMERA_FRAME.png"
        )
    shots, rate = _timed(shots, times)
    checked_rate(rate, f"the times in {path}")
    return shots, declared if declared and math.isclose(declared, rate, rel_tol=1e-6) else rate


def _rate(entry: _Entry, path: Path) -> float | None:
    """The frame rate that a file declares, or None."""
    rate = field(entry.intrinsics, "fps", Optional[float], str(entry.listed_in), CORRECT, None)  # noqa: UP045
    return checked_rate(rate, str(path)) if rate else None  # 0 is how some programs say that there is none


def _timed(shots: dict[str, Shot], times: dict[str, float]) -> tuple[dict[str, Shot], float]:
    """Frames and their rate; frames are counted by time where the numbers in names do not grow with it."""
    numbers, instants = zip(*sorted({(shots[name].frame, time) for name, time in times.items()}))
    distinct = sorted(set(instants))
    if list(instants) == distinct and len(set(numbers)) == len(numbers):
        return shots, (numbers[-1] - numbers[0]) / (distinct[-1] - distinct[0])
    rank = {time: number for number, time in enumerate(distinct)}
    counted = {name: Shot(shot.camera, rank[times[name]]) for name, shot in shots.items()}
    return counted, (len(distinct) - 1) / (distinct[-1] - distinct[0])


def _still(group: list[_Entry]) -> bool:
    first = group[0].matrix
    return all(np.abs(entry.matrix - first).max() <= SAME_POSE * max(np.abs(first).max(), 1) for entry in group)


def _camera(name: str, entry: _Entry) -> tuple[Camera, Lens]:
    """The pinhole camera of the undistorted images, and the lens of the recorded ones."""
    size, where = image_size(entry.file), str(entry.listed_in)
    check_name(name, where)
    camera = read_entry(name, entry.intrinsics, entry.matrix, size, where).recorded(size, where)
    return camera.pinhole(where), camera.lens


def _split_notes(entries: dict[str, _Entry], shots: dict[str, Shot]) -> tuple[str, ...]:
    """Which cameras each file lists; how a run splits them stays a setting."""
    listed: dict[str, set[str]] = {}
    for name, entry in entries.items():
        listed.setdefault(entry.listed_in.name, set()).add(shots[name].camera)
    if len(listed) == 1:
        return ()
    return tuple(f"{file} lists {', '.join(sorted(cameras))}" for file, cameras in listed.items())

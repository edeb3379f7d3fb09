"""Blender's and Instant-NGP's transforms.json: a list of images, each with its pose, time and intrinsics.

`transform_matrix` maps camera to world with OpenGL axes (x right, y up, z backward). `time` is in any unit: seconds in
converted multi-view recordings, 0 to 1 in D-NeRF's scenes. Images of one pose are the frames of one camera; a file
without times from many poses is one instant. Intrinsics may stand at the top or beside each image.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Optional

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.reading import field, read_json
from d2_plugin.recordings.assembly import CORRECT, assembled
from d2_plugin.recordings.cameras.camera import CalibratedCamera, check_name, checked_rate
from d2_plugin.recordings.cameras.formats.transforms import ListedImage, camera_of, listed_images, still
from d2_plugin.recordings.files import Shot, arrange, by_camera, common_frames
from d2_plugin.recordings.images import IMAGE_SUFFIXES, image_size
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import counted

FILES = ("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json")
"""All that are there are read; their images are joined."""

ROUNDED = 0.01  # frames by which times are off that were written with few digits

STATIC_FPS = 30.0  # frame rate of files without times, where it means nothing


class _Entry(NamedTuple):
    image: ListedImage
    file: Path
    listed_in: Path


def open_transforms(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read transforms.json, or transforms_train.json with its companions; only headers of images are opened.

    Missing images are refused by name, or left out with a note where `intersect`.

    Raises:
        D2Error: among others for a camera that moves over time: the cameras of a `Recording` stand still.
    """
    entries, notes = _present(_entries(path), intersect)
    shots, fps = _shots(entries, path)
    files = by_camera(shots, {name: entry.file for name, entry in entries.items()})
    refuse_unknown("camera", cameras or (), files)
    images = {name: files[name] for name in (cameras or files)}
    frames, frame_notes = common_frames(images, path)
    first = {shot.camera: entries[name] for name, shot in shots.items() if shot.frame == frames[0]}
    calibrated = {name: _camera(name, first[name]) for name in images}
    notes = (*notes, *_split_notes(entries, shots), *frame_notes)
    recording = assembled(path, calibrated, images, frames, fps, str(path), notes)
    begin = next((entries[name].image.time for name, shot in shots.items() if shot.frame == frames[0]), None)
    late: dict[str, dict[int, float]] = {}
    for name, shot in shots.items():
        own = entries[name].image.late
        if begin is not None and (time := entries[name].image.time) is not None:
            uneven = time - begin - recording.seconds(shot.frame)
            own += uneven if abs(uneven) * fps > ROUNDED else 0.0
        if own:
            late.setdefault(shot.camera, {})[shot.frame] = own
    return replace(recording, late=late)


def _entries(path: Path) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
    for listed_in in (path / name for name in FILES if (path / name).is_file()):
        for image in listed_images(read_json(listed_in, CORRECT), str(listed_in)):
            file = _image_file(listed_in.parent / image.name)
            entries.setdefault(image.name, _Entry(image, file, listed_in))  # listed by several files, it counts once
    if not entries:
        raise D2Error(f"{path} has no transforms.json or transforms_train.json that lists images: give one that does")
    return entries


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
    return present, (f"{counted(len(missing), 'listed image')} left out: no such file",) if missing else ()


def _shots(entries: dict[str, _Entry], path: Path) -> tuple[dict[str, Shot], float]:
    """Camera and frame of every image, and frames per unit of time."""
    declared = _rate(next(iter(entries.values())), path)
    shots, _ = arrange(entries, lambda group: still([entries[name].image for name in group]))
    times = {name: entry.image.time for name, entry in entries.items() if entry.image.time is not None}
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
    rate = field(entry.image.table, "fps", Optional[float], str(entry.listed_in), CORRECT, None)  # noqa: UP045
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


def _camera(name: str, entry: _Entry) -> CalibratedCamera:
    size, where = image_size(entry.file), str(entry.listed_in)
    check_name(name, where)
    camera = camera_of(entry.image, name, size, where).of_size(size, where)
    camera.pinhole(where)
    return camera


def _split_notes(entries: dict[str, _Entry], shots: dict[str, Shot]) -> tuple[str, ...]:
    """Which cameras each file lists; how a run splits them stays a setting."""
    listed: dict[str, set[str]] = {}
    for name, entry in entries.items():
        listed.setdefault(entry.listed_in.name, set()).add(shots[name].camera)
    if len(listed) == 1:
        return ()
    return tuple(f"{file} lists {', '.join(sorted(cameras))}" for file, cameras in listed.items())

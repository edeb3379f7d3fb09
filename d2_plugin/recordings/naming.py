"""Which camera and which frame an image shows, read from its name, for data sets that list images one by one.

Three habits are understood: CAMERA/FRAME.png, CAMERA_FRAME.png, and one image per camera. Folders called `images` or
`.` say nothing about the camera, wherever they stand.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Optional

from d2_plugin.errors import D2Error
from d2_plugin.recordings.files import FrameFiles, frame_number
from d2_plugin.recordings.images import IMAGE_SUFFIXES


class Shot(NamedTuple):
    """What an image's name says it shows."""

    camera: str
    frame: int


_FRAME = re.compile(r"(\d+)\D*$")
_PREFIXED = re.compile(r"(?P<camera>.+)_(?P<frame>\d+)$")


Reading = Callable[[str], Optional[Shot]]  # noqa: UP045  at run time, on Python 3.9 too
"""One way to read a name; None for a name that does not say both camera and frame."""


def in_folders(name: str) -> Shot | None:
    """cam00/0012.png, or cam00_0012.png where there is no folder, as camera cam00 at frame 12."""
    *folders, stem = _parts(name)
    number = _FRAME.search(stem)
    if folders:
        return Shot("_".join(folders), frame_number(number[1], name)) if number else None
    return by_prefix(name)


def by_prefix(name: str) -> Shot | None:
    """train/cam00_0012.png as camera cam00 at frame 12, whatever the folder says."""
    match = _PREFIXED.match(_parts(name)[-1])
    return Shot(match["camera"], frame_number(match["frame"], name)) if match else None


def arrange(names: Iterable[str], still: Callable[[list[str]], bool]) -> tuple[dict[str, Shot], Reading | None]:
    """Camera and frame of every name, and the reading that was used.

    `still` says whether the images of one presumed camera were taken from one pose. Where that holds for no reading,
    as in a still scene photographed by one moving camera, every image is a camera of its own at frame 0 and the
    reading is None.
    """
    names = list(dict.fromkeys(names))
    for reading in (in_folders, by_prefix):
        shots = {name: shot for name in names if (shot := reading(name)) is not None}
        if len(shots) == len(names) and all(still(group) for group in _by_camera_name(shots)):
            return shots, reading
    return one_instant(names), None


def _by_camera_name(shots: Mapping[str, Shot]) -> Iterable[list[str]]:
    groups: dict[str, list[str]] = {}
    for name, shot in shots.items():
        groups.setdefault(shot.camera, []).append(name)
    return groups.values()


def one_instant(names: Iterable[str]) -> dict[str, Shot]:
    """Every image as a camera of its own at frame 0, named by its stem, or by its whole path where stems repeat."""
    parts = {name: _parts(name) for name in names}
    stems = Counter(part[-1] for part in parts.values())
    repeated = max(stems.values(), default=0) > 1
    return {name: Shot("_".join(part) if repeated else part[-1], 0) for name, part in parts.items()}


def images_below(folder: Path) -> dict[str, Path]:
    """Every image under `folder` by its path relative to it, sorted."""
    if not folder.is_dir():
        raise D2Error(f"{folder} is no folder: expected the images of the recording there")
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return {path.relative_to(folder).as_posix(): path for path in found}


def by_camera(shots: Mapping[str, Shot], files: Mapping[str, Path]) -> dict[str, FrameFiles]:
    """Frame -> file per camera, sorted by camera; refuses two files of one camera and frame."""
    found: dict[str, FrameFiles] = {}
    for name, (camera, frame) in shots.items():
        taken = found.setdefault(camera, {})
        if frame in taken:
            raise D2Error(f"{taken[frame]} and {files[name]} are both frame {frame} of camera {camera}: remove one")
        taken[frame] = files[name]
    return {camera: dict(sorted(found[camera].items())) for camera in sorted(found)}


def _parts(name: str) -> list[str]:
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts:
        raise D2Error(f"an image is called '{name}': every image needs the name of its file")
    *folders, last = parts
    stem = last[: -len(suffix)] if (suffix := PurePosixPath(last).suffix).lower() in IMAGE_SUFFIXES else last
    return [folder for folder in folders if folder not in (".", "..", "/", "images")] + [stem]

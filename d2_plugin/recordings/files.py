"""Which camera and which frame a file shows: by the number in its name, or by its whole path where files are listed.

Of listed images three habits are understood: CAMERA/FRAME.png, CAMERA_FRAME.png, and one image per camera. Folders
called `images` or `.` say nothing about the camera, wherever they stand.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Optional

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import shown_path
from d2_plugin.recordings.images import IMAGE_SUFFIXES
from d2_plugin.values import counted

FrameFiles = dict[int, Path]

MOST_DIGITS = 9  # of a frame number

_LAST_NUMBER = re.compile(r"(\d+)\D*$")
_SECONDS = re.compile(r"\d+\.\d+")
_PREFIXED = re.compile(r"(?P<camera>.+)_(?P<frame>\d+)$")


class Shot(NamedTuple):
    """What an image's name says it shows."""

    camera: str
    frame: int


Reading = Callable[[str], Optional[Shot]]  # noqa: UP045  at run time, on Python 3.9 too
"""One way to read a name; None for a name that does not say both camera and frame."""


def is_called(path: Path, suffixes: Collection[str] = IMAGE_SUFFIXES) -> bool:
    """Whether a file is called like an image; hidden ones, which macOS puts beside each file, are not."""
    return path.suffix.lower() in suffixes and not path.name.startswith(".")


def numbered_files(folder: Path, suffixes: Collection[str] = IMAGE_SUFFIXES) -> FrameFiles:
    """Frame number -> file for everything in `folder` with one of `suffixes`; the last number in a name counts.

    Raises `D2Error` for a file without a number and for two files of one frame (1.png beside 00001.jpg).
    """
    files: FrameFiles = {}
    for path in sorted(path for path in folder.iterdir() if is_called(path, suffixes)):
        number = _LAST_NUMBER.search(path.stem)
        if number is None:
            raise D2Error(f"{path} has no frame number in its name: name it like 00012{path.suffix}")
        if _SECONDS.fullmatch(path.stem):
            raise D2Error(f"{path} is named by a time: name the frames 00000{path.suffix}, 00001{path.suffix}, ...")
        frame = frame_number(number[1], path)
        if frame in files:
            raise D2Error(f"{files[frame].name} and {path.name} in {path.parent} are both frame {frame}: remove one")
        files[frame] = path
    return files


def camera_folders(folder: Path) -> dict[str, Path]:
    """The folders in `folder` that hold images, by their names; hidden ones are no cameras."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    shown = (one for one in inside if one.is_dir() and not one.name.startswith("."))
    return {one.name: one for one in shown if any(map(is_called, one.iterdir()))}


def files_by_camera(
    folder: Path, cameras: Iterable[str], suffixes: Collection[str] = IMAGE_SUFFIXES
) -> dict[str, FrameFiles]:
    """`numbered_files` of each camera that has a folder of its name in `folder`."""
    return {name: numbered_files(folder / name, suffixes) for name in cameras if (folder / name).is_dir()}


def frame_number(digits: str, path: Path | str) -> int:
    """The frame that digits in the name of an image say."""
    if len(digits) > MOST_DIGITS:
        raise D2Error(f"{shown_path(path)} has a number of {len(digits)} digits, at most {MOST_DIGITS}: rename it")
    return int(digits)


def common_frames(files: Mapping[str, Iterable[int]], where: Path) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """(frames that every camera has, ascending; a note when some camera has more)."""
    sets = [set(frames) for frames in files.values()]
    shared, every = set.intersection(*sets), set.union(*sets)
    if not every:
        raise D2Error(f"no frames in {where}: expected images named like 00000.png or 00000.jpg")
    if not shared:
        raise D2Error(f"no frame in {where} is there for all of {', '.join(files)}: give every camera the same frames")
    out = len(every - shared)
    return tuple(sorted(shared)), (f"{counted(out, 'frame')} left out: not every camera has them",) if out else ()


def cameras_with_images(
    calibrated: Iterable[str], pictured: Collection[str], asked: tuple[str, ...] | None, intersect: bool, where: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras to read, notes): the cameras that are `asked` for, or all that `where` describes.

    Where nothing was asked for, cameras without images and images of cameras that `where` does not describe are
    refused by name, or left out with a note where `intersect`. A camera that is asked for must have both.
    """
    known = list(calibrated)
    wanted = [*known, *(name for name in pictured if name not in known)] if asked is None else list(asked)
    for name in wanted:
        if name not in known and name not in pictured:
            raise unknown_name("camera", name, known)
    unknown = [name for name in wanted if name not in known]
    missing = [name for name in wanted if name not in pictured]
    both = [name for name in wanted if name in known and name in pictured]
    may_leave_out = intersect and asked is None and both
    if unknown and not may_leave_out:
        raise D2Error(
            f"camera {', '.join(unknown)} has images but is not in {where}, which has {', '.join(known)}: add its "
            "calibration or choose the cameras to read"
        )
    if missing and not may_leave_out:
        raise D2Error(
            f"camera {', '.join(missing)} of {where} has no image ({', '.join(IMAGE_SUFFIXES)}): add its images or "
            "choose the cameras to read"
        )
    left_out = {"images": missing, "calibration": unknown}
    parts = [f"{what} missing: {', '.join(cameras)}" for what, cameras in left_out.items() if cameras]
    return both, (f"left out, {'; '.join(parts)}",) if parts else ()


def in_folders(name: str) -> Shot | None:
    """cam00/0012.png, or cam00_0012.png where there is no folder, as camera cam00 at frame 12."""
    *folders, stem = _parts(name)
    number = _LAST_NUMBER.search(stem)
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
        groups: dict[str, list[str]] = {}
        for name, shot in shots.items():
            groups.setdefault(shot.camera, []).append(name)
        if len(shots) == len(names) and all(still(group) for group in groups.values()):
            return shots, reading
    parts = {name: _parts(name) for name in names}
    repeated = max(Counter(part[-1] for part in parts.values()).values(), default=0) > 1
    return {name: Shot("_".join(part) if repeated else part[-1], 0) for name, part in parts.items()}, None


def images_below(folder: Path) -> dict[str, Path]:
    """Every image under `folder` by its path relative to it, sorted."""
    if not folder.is_dir():
        raise D2Error(f"{folder} is no folder: expected the images of the recording there")
    linked = (path for path in folder.iterdir() if path.is_symlink() and path.is_dir())  # `rglob` follows no links
    paths = sorted(path for place in (folder, *linked) for path in place.rglob("*") if is_called(path))
    return {path.relative_to(folder).as_posix(): path for path in paths}


def by_camera(shots: Mapping[str, Shot], files: Mapping[str, Path]) -> dict[str, FrameFiles]:
    """Frame -> file per camera, sorted by camera; refuses two files of one camera and frame."""
    taken: dict[str, FrameFiles] = {}
    for name, (camera, frame) in shots.items():
        own = taken.setdefault(camera, {})
        if frame in own:
            raise D2Error(f"{own[frame]} and {files[name]} are both frame {frame} of camera {camera}: remove one")
        own[frame] = files[name]
    return {camera: dict(sorted(taken[camera].items())) for camera in sorted(taken)}


def _parts(name: str) -> list[str]:
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts:
        raise D2Error(f"an image is called '{name}': every image needs the name of its file")
    *folders, last = parts
    stem = last[: -len(suffix)] if (suffix := PurePosixPath(last).suffix).lower() in IMAGE_SUFFIXES else last
    return [folder for folder in folders if folder not in (".", "..", "/", "images")] + [stem]

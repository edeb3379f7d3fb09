"""Which frame lies in which file: images and maps found by the number in their name."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import shown_path
from d2_plugin.recordings.images import IMAGE_SUFFIXES

FrameFiles = dict[int, Path]

MOST_DIGITS = 9
"""Of a frame number."""

_LAST_NUMBER = re.compile(r"(\d+)\D*$")


def numbered_files(folder: Path, suffixes: Iterable[str] = IMAGE_SUFFIXES) -> FrameFiles:
    """Frame number -> file for everything in `folder` with one of `suffixes`; the last number in a name counts.

    Raises `D2Error` for a file without a number and for two files of one frame (1.png beside 00001.jpg).
    """
    wanted = tuple(suffixes)
    return collect(path for path in sorted(folder.iterdir()) if path.suffix.lower() in wanted)


def collect(paths: Iterable[Path]) -> FrameFiles:
    """Frame number -> path; see `numbered_files`."""
    found: FrameFiles = {}
    for path in paths:
        number = _LAST_NUMBER.search(path.stem)
        if number is None:
            raise D2Error(f"{path} has no frame number in its name: name it like 00012{path.suffix}")
        frame = frame_number(number.group(1), path)
        if frame in found:
            raise D2Error(f"{found[frame].name} and {path.name} in {path.parent} are both frame {frame}: remove one")
        found[frame] = path
    return found


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
    notes = (f"{len(every - shared)} frames left out because not every camera has them",) if every - shared else ()
    return tuple(sorted(shared)), notes


def cameras_with_images(
    calibrated: Iterable[str], pictured: Collection[str], asked: tuple[str, ...] | None, intersect: bool, where: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras to read, notes): the cameras that are `asked` for, or all that `where` describes.

    Where nothing was asked for, cameras without images and images of cameras that `where` does not describe are
    refused by name, or left out with a note where `intersect`. A camera that is asked for must have both.
    """
    known = list(calibrated)
    unknown = [name for name in pictured if name not in known] if asked is None else []
    if unknown and not intersect:
        raise D2Error(
            f"camera {', '.join(unknown)} has images but is not in {where}, which has {', '.join(known)}: add its "
            "calibration or choose the cameras to read"
        )
    names = known if asked is None else list(asked)
    for name in names:
        if name not in known:
            raise unknown_name("camera", name, known)
    missing = [name for name in names if name not in pictured]
    if missing and (asked is not None or not intersect or len(missing) == len(names)):
        raise D2Error(
            f"camera {', '.join(missing)} of {where} has no image: add its images or choose the cameras to read"
        )
    left_out = {"images": missing, "calibration": unknown}
    notes = tuple(f"left out, {what} missing: {', '.join(cameras)}" for what, cameras in left_out.items() if cameras)
    return [name for name in names if name in pictured], notes

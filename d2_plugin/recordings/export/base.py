"""What every writer of a layout starts from and hands back, and the checks that several of them share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from d2_plugin.durable import LEFTOVER, make_folder, writing
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.recordings.export.ply import PointCloud
from d2_plugin.recordings.images import write_png
from d2_plugin.recordings.recording import Camera, Recording


class Written(NamedTuple):
    """What the cameras and frames of the source are called in the export; those that were not written are absent."""

    cameras: dict[str, str]
    frames: dict[int, int]


@dataclass(frozen=True)
class Export:
    """What a layout is written from: a recording, which of its cameras are held out, and where Gaussians start."""

    recording: Recording
    test_cameras: tuple[str, ...]
    cloud: PointCloud | None
    folder: Path

    @property
    def train_cameras(self) -> tuple[str, ...]:
        """The cameras that are not held out, in the recording's order."""
        return tuple(name for name in self.recording.cameras if name not in self.test_cameras)

    def write_images(self, place: Callable[[str, int], Path], frames: Sequence[int] | None = None) -> None:
        """Every frame (or those given) of every camera as a lossless PNG at `place(camera, frame)`."""
        for camera in self.recording.cameras:
            for frame in self.recording.frames if frames is None else frames:
                write_png(place(camera, frame), self.recording.image(camera, frame))

    def written(self, cameras: Mapping[str, str] | None = None, frames: Mapping[int, int] | None = None) -> Written:
        """What a writer returns; names that are not given were kept."""
        return Written(
            {name: name for name in self.recording.cameras} if cameras is None else dict(cameras),
            {frame: frame for frame in self.recording.frames} if frames is None else dict(frames),
        )


def refuse_off_centre(camera: Camera, layout: str) -> None:
    """Raise `D2Error` for a camera that one focal length and a centred principal point do not describe."""
    fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    slack = 1e-6 * camera.width
    if abs(fx - fy) > slack or abs(cx - camera.width / 2) > slack or abs(cy - camera.height / 2) > slack:
        raise D2Error(
            f"camera {camera.name} has fx {fx:g}, fy {fy:g} and principal point ({cx:g}, {cy:g}) but layout {layout} "
            f"holds one focal length and the centre ({camera.width / 2:g}, {camera.height / 2:g}) only: "
            "choose the layout transforms"
        )


def unused_folder(path: Path | str) -> Path:
    """Where `path` leads, which holds nothing yet; a `D2Error` if it does."""
    folder = Path(os.path.realpath(path))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise D2Error(f"{path} already exists and is not empty: choose another folder, nothing was written")
    return folder


@contextmanager
def whole_folder(path: Path | str) -> Iterator[Path]:
    """Within it, a folder to write to, which takes the place of `path` at the end: there is all of it, or nothing.

    What a killed export left is removed by the next. Where `path` is the current folder or a disk of its own, it is
    written directly, since no other folder can take its place.

    Raises:
        D2Error: `path` holds something, somebody else is writing it, or the disk is full, broken or not ours.
    """
    folder = unused_folder(path)
    if folder == Path.cwd() or folder.is_mount():
        with only_writer(folder), writing(folder):
            yield folder
        return
    unfinished = folder.with_name(f".{folder.name}{LEFTOVER}")
    if unfinished.is_symlink():  # what is left there is removed, and nobody's link may say what that is
        raise D2Error(f"{unfinished} is a link, and an unfinished export is none: remove it")
    make_folder(unfinished)
    with only_writer(unfinished), writing(folder):
        for left in unfinished.iterdir():
            shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
        try:
            yield unfinished
            os.replace(unfinished, folder)
        except BaseException:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise

"""Neural 3D Video: camXX.mp4 beside poses_bounds.npy, or the same frames extracted as pictures.

Row i of poses_bounds.npy belongs to the i-th camera in sorted order. Its first fifteen numbers are a 3 x 5 matrix whose
columns are the camera's down, right and back axes, its centre, and (height, width, focal length); the last two are the
near and far depth. The principal point is the centre of the picture.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from d2_plugin.captures.assembly import assembled
from d2_plugin.captures.calibration import checked_camera, pinhole, rigid
from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.files import FrameFiles, collect, common_frames, numbered_files
from d2_plugin.captures.pictures import PICTURE_SUFFIXES, picture_size
from d2_plugin.captures.video import VideoSource, video_header
from d2_plugin.errors import D2Error, unknown_name

log = logging.getLogger(__name__)

N3DV_FPS = 30.0
"""Frame rate of the data set, where no video says it."""

UNSYNCHRONISED = {"coffee_martini": ("cam13",)}
"""Cameras of the data set whose video runs beside the others' time (MixVoxels and K-Planes leave them out)."""

_EXTRACTED_NAME = re.compile(r"(?P<camera>.+)_\d+$")


def open_n3dv(path: Path, cameras: tuple[str, ...] | None = None) -> Capture:
    """Read the N3DV layout; frames are decoded when asked for, only headers are opened here."""
    rows = _rows(path / "poses_bounds.npy")
    videos = {video.stem: video for video in sorted(path.glob("cam*.mp4"))}
    extracted = {} if videos else _extracted(path)
    present = list(videos or extracted)
    if not present:
        raise D2Error(f"{path} has poses_bounds.npy but no cam*.mp4 and no extracted frames: add the videos")
    if len(present) != len(rows):
        raise D2Error(
            f"{path / 'poses_bounds.npy'} has {len(rows)} rows for {len(present)} cameras ({', '.join(present)}): "
            "rows belong to the cameras in sorted order, so add or remove what does not match"
        )
    names = present if cameras is None else list(cameras)
    for name in names:
        if name not in present:
            raise unknown_name("camera", name, present)
    by_name = dict(zip(present, rows))
    return _from_videos(path, by_name, videos, names) if videos else _from_pictures(path, by_name, extracted, names)


def camera_from_row(row: np.ndarray, name: str, size: tuple[int, int] | None, where: str) -> Camera:
    """The OpenCV camera of one row [17] of poses_bounds.npy for pictures of `size` (width, height).

    `size` None means the size in the row; another one must have the same aspect and scales the focal length.
    """
    pose = np.asarray(row[:15], np.float64).reshape(3, 5)
    height, width, focal = pose[:, 4]
    if not np.isfinite(row).all() or min(height, width) < 1:
        raise D2Error(
            f"the row of camera {name} in {where} has a number that is not finite or a size below one pixel: "
            "correct the calibration"
        )
    size = size or (round(width), round(height))
    scale = size[0] / width
    if abs(size[1] / height - scale) > 0.01 * scale:
        raise D2Error(
            f"pictures of camera {name} are {size[0]}x{size[1]} but {where} says {width:g}x{height:g}, another aspect: "
            "use pictures that are scaled, not cropped"
        )
    # Columns of the row are down, right, back; OpenCV's rows are right, down, forward.
    rotation = np.stack([pose[:, 1], pose[:, 0], -pose[:, 2]])
    K = pinhole(focal * scale, focal * scale, size[0] / 2, size[1] / 2)
    transform = rigid(rotation, -rotation @ pose[:, 3])
    return checked_camera(name, size, K, transform, (float(row[15]), float(row[16])), where)


def _rows(path: Path) -> np.ndarray:
    try:
        rows = np.load(path)
    except (OSError, ValueError, EOFError) as failure:
        raise D2Error(f"cannot read {path} ({failure}): replace the file") from None
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise D2Error(f"{path} has shape {rows.shape}, expected [cameras, 17]: see the LLFF format")
    return rows.astype(np.float64)


def _from_videos(path: Path, rows: dict[str, np.ndarray], videos: dict[str, Path], names: list[str]) -> Capture:
    found = {name: video_header(videos[name]) for name in names}
    frames, notes = common_frames({name: range(header.frames) for name, header in found.items()}, path)
    where = str(path / "poses_bounds.npy")
    return Capture(
        name=path.resolve().name,
        cameras={name: camera_from_row(rows[name], name, found[name].size, where) for name in names},
        frames=frames,
        fps=found[names[0]].fps or N3DV_FPS,
        source=VideoSource({name: videos[name] for name in names}),
        path=path,
        notes=(*notes, *_known_flaws(path, names)),
    )


def _from_pictures(
    path: Path, rows: dict[str, np.ndarray], extracted: dict[str, FrameFiles], names: list[str]
) -> Capture:
    files = {name: extracted[name] for name in names}
    frames, notes = common_frames(files, path)
    where = str(path / "poses_bounds.npy")
    cameras = {name: camera_from_row(rows[name], name, picture_size(files[name][frames[0]]), where) for name in names}
    return assembled(path, cameras, files, frames, N3DV_FPS, (*notes, *_known_flaws(path, names)))


def _known_flaws(path: Path, names: list[str]) -> tuple[str, ...]:
    flawed = [name for name in names if name in UNSYNCHRONISED.get(path.resolve().name, ())]
    notes = tuple(f"{name} is known to be unsynchronised: consider leaving it out" for name in flawed)
    for note in notes:
        log.warning("%s", note)
    return notes


def _extracted(path: Path) -> dict[str, FrameFiles]:
    """Frames extracted as camXX/images/*, camXX/*, images/camXX/* or images/camXX_0000.*, cameras sorted."""
    for pattern in ("cam*/images", "cam*", "images/*"):
        folders = [folder for folder in sorted(path.glob(pattern)) if folder.is_dir()]
        cameras = [folder.parent.name if folder.name == "images" else folder.name for folder in folders]
        found = {camera: numbered_files(folder) for camera, folder in zip(cameras, folders)}
        if found and all(found.values()):
            return found
    return dict(_by_prefix(path / "images"))


def _by_prefix(folder: Path) -> Iterator[tuple[str, FrameFiles]]:
    pictures = sorted(file for file in folder.glob("*_*") if file.suffix.lower() in PICTURE_SUFFIXES)
    prefixes: dict[str, list[Path]] = {}
    for picture in pictures:
        match = _EXTRACTED_NAME.match(picture.stem)
        if match:
            prefixes.setdefault(match["camera"], []).append(picture)
    for camera, paths in sorted(prefixes.items()):
        yield camera, collect(paths)

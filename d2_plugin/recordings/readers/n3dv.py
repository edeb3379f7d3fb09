"""Neural 3D Video: camXX.mp4 beside poses_bounds.npy, or the same frames extracted as images.

Row i of poses_bounds.npy belongs to the i-th camera in sorted order. Its first fifteen numbers are a 3 x 5 matrix whose
columns are the camera's down, right and back axes, its centre, and (height, width, focal length); the last two are the
near and far depth. The principal point is the centre of the image.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.camera import LARGEST_NUMBER, CalibratedCamera, checked_rate, pinhole, rigid
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.files import (
    FrameFiles,
    by_camera,
    by_prefix,
    cameras_with_images,
    common_frames,
    numbered_files,
)
from d2_plugin.recordings.images import IMAGE_SUFFIXES, image_size
from d2_plugin.recordings.importing.video import VideoFrames, read_video, usual_rate
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import counted

POSES = "poses_bounds.npy"

N3DV_FPS = 30.0  # frame rate of the data set, where no video says it, with a note

UNSYNCHRONISED = {"coffee_martini": ("cam13",)}
"""Cameras whose video is not synchronised with the others. MixVoxels and K-Planes leave them out, too."""

RIG_SIZE = 21
"""Cameras of the rig, cam00 to cam20. Scenes with fewer rows lack cameras, and their rows do not say which."""

_NUMBERED_NAME = re.compile(r"cam(\d+)$")


def open_n3dv(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the N3DV layout; frames are decoded when asked for, time stamps and headers alone are read here.

    A camera whose video or folder is empty is refused by name, and so are rows without a camera. Where `intersect`
    both are left out with a note: an empty camera keeps its row, and of the whole rig (`RIG_SIZE` rows) the number in
    a camera's name says which row is its own. Otherwise nothing says which row belongs to which camera.
    """
    videos = {video.stem: video for video in sorted(path.glob("cam*.mp4"))}
    extracted = {} if videos else _extracted(path)
    listed = list(videos or extracted)
    if not listed:
        raise D2Error(f"{path} has {POSES} but no cam*.mp4 and no extracted frames: add the videos")
    rows, notes = _assigned(_rows(path / POSES), listed, intersect, path / POSES)
    pictured = {name for name in listed if (videos[name].stat().st_size if videos else extracted[name])}
    names, missing = cameras_with_images(rows, pictured, cameras, intersect, path / POSES)
    flawed = [name for name in names if name in UNSYNCHRONISED.get(path.resolve().name, ())]
    flaws = (f"{name} is known to be unsynchronised: consider leaving it out" for name in flawed)
    notes, where = (*notes, *missing, *flaws), str(path / POSES)
    if not videos:
        images = {name: extracted[name] for name in names}
        frames, more = common_frames(images, path)
        sizes = {name: image_size(images[name][frames[0]]) for name in names}
        calibrated = {name: camera_from_row(rows[name], name, sizes[name], where) for name in names}
        rate = (f"extracted frames name no fps: {N3DV_FPS:g} taken, as the data set has",) if len(frames) > 1 else ()
        return assembled(path, calibrated, images, frames, N3DV_FPS, where, (*notes, *more, *rate))
    files = {name: read_video(videos[name]) for name in names}
    frames, more = common_frames({name: range(len(file.stamps)) for name, file in files.items()}, path)
    pinholes = {name: camera_from_row(rows[name], name, files[name].size, where).pinhole(where) for name in names}
    fps = checked_rate(usual_rate(files[names[0]].rate) or N3DV_FPS, str(videos[names[0]]))
    return Recording(path.resolve().name, pinholes, frames, fps, VideoFrames(files), path, notes=(*notes, *more))


def _assigned(
    rows: np.ndarray, listed: list[str], intersect: bool, where: Path
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """(row of each camera, notes); rows belong to the cameras in sorted order, or to their numbers in a whole rig."""
    if len(rows) == len(listed):
        return dict(zip(listed, rows)), ()
    numbers = {name: int(match[1]) for name in listed if (match := _NUMBERED_NAME.match(name))}
    if intersect and len(rows) == RIG_SIZE and len(numbers) == len(listed) and max(numbers.values()) < RIG_SIZE:
        absent = len(rows) - len(listed)
        note = f"{absent} of {RIG_SIZE} cameras are not there and left out: rows are taken by the cameras' numbers"
        return {name: rows[number] for name, number in numbers.items()}, (note,)
    raise D2Error(
        f"{where} has {counted(len(rows), 'row')} for {counted(len(listed), 'camera')} ({', '.join(listed)}): "
        "rows belong to the cameras in sorted order, so add or remove what does not match"
    )


def camera_from_row(row: np.ndarray, name: str, size: tuple[int, int] | None, where: str) -> CalibratedCamera:
    """The camera of one row [17] of poses_bounds.npy for images of `size` (width, height).

    `size` None means the size in the row; another one must have the same aspect and scales the focal length.
    """
    pose = np.asarray(row[:15], np.float64).reshape(3, 5)
    height, width, focal = pose[:, 4]
    if not (np.abs(row) <= LARGEST_NUMBER).all() or min(height, width) < 1:
        raise D2Error(
            f"the row of camera {name} in {where} has a number that is not finite, one beyond {LARGEST_NUMBER:g} or a "
            "size below one pixel: correct the calibration"
        )
    size = size or (round(width), round(height))
    scale = size[0] / width
    if abs(size[1] / height - scale) > 0.01 * scale:
        raise D2Error(
            f"images of camera {name} are {size[0]}x{size[1]} but {where} says {width:g}x{height:g}, another aspect: "
            "use images that are scaled, not cropped"
        )
    # Columns of the row are down, right, back; OpenCV's rows are right, down, forward.
    rotation = np.stack([pose[:, 1], pose[:, 0], -pose[:, 2]])
    lens = Lens(pinhole(focal * scale, focal * scale, size[0] / 2, size[1] / 2))
    transform = rigid(rotation, -rotation @ pose[:, 3])
    return CalibratedCamera(name, *size, lens, transform, (float(row[15]), float(row[16])))


def _rows(path: Path) -> np.ndarray:
    rows = read_array(path, "replace the file")
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise D2Error(f"{path} has shape {rows.shape}, expected [cameras, 17]: see the LLFF format")
    return rows.astype(np.float64)


def _extracted(path: Path) -> dict[str, FrameFiles]:
    """Frames extracted as camXX/images/*, camXX/*, images/camXX/* or images/camXX_0000.*, cameras sorted.

    A camera whose folder is empty has no frames.
    """
    partly: dict[str, FrameFiles] = {}
    for pattern in ("cam*/images", "cam*", "images/*"):
        folders = [folder for folder in sorted(path.glob(pattern)) if folder.is_dir()]
        cameras = [folder.parent.name if folder.name == "images" else folder.name for folder in folders]
        files = {camera: numbered_files(folder) for camera, folder in zip(cameras, folders)}
        if files and all(files.values()):
            return files
        if not partly and any(files.values()):
            partly = files
    loose = {file.name: file for file in (path / "images").glob("[!.]*_*") if file.suffix.lower() in IMAGE_SUFFIXES}
    return partly or by_camera({name: shot for name in sorted(loose) if (shot := by_prefix(name))}, loose)

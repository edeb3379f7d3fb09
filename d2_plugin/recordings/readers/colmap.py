"""A recording whose cameras are a COLMAP model: sparse/0 (binary or text) beside images/.

Images are named CAMERA/FRAME.png or CAMERA_FRAME.png. It is enough that one frame of each camera is registered: the
cameras stand still, so further frames on disk share its pose. A model of one still scene from a moving camera becomes
a recording of one instant with a camera per image.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from d2_plugin.errors import D2Error
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.formats.colmap import (
    ColmapImage,
    ColmapModel,
    find_model,
    read_model,
    standing_cameras,
)
from d2_plugin.recordings.files import Shot, by_camera, cameras_with_images, common_frames, images_below
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import counted

COLMAP_FPS = 30.0  # frame rate that is assumed, with a note: a COLMAP model says nothing about time


def is_colmap(path: Path) -> bool:
    """Whether a COLMAP model lies in `path` or where COLMAP puts one below it."""
    return find_model(path) is not None


def open_colmap(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the COLMAP layout; of the images only headers are opened.

    `cameras` restricts everything to the named ones. Registered cameras whose images are missing are refused by
    name, or left out with a note where `intersect`. Images that are not registered are always left out with a note.
    """
    folder = find_model(path)
    if folder is None:
        raise D2Error(f"{path} holds no COLMAP model: expected cameras.bin and images.bin (or .txt) in sparse/0")
    model, files = read_model(folder), images_below(path / "images")
    poses, shots, notes = _shots(model, files)
    pictured = by_camera({name: shot for name, shot in shots.items() if name in files}, files)
    names, missing = cameras_with_images(poses, pictured, cameras, intersect, folder)
    images = {name: pictured[name] for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    calibrated = {
        name: model.calibrated(name, poses[name]).of_size(image_size(images[name][frames[0]]), str(folder))
        for name in names
    }
    notes = (*notes, *missing, *frame_notes)
    if len(frames) > 1:
        notes = (*notes, f"a COLMAP model names no frame rate: {COLMAP_FPS:g} taken")
    return assembled(path, calibrated, images, frames, COLMAP_FPS, str(folder), notes)


def _shots(model: ColmapModel, files: Iterable[str]) -> tuple[dict[str, ColmapImage], dict[str, Shot], tuple[str, ...]]:
    """One registered image per camera, camera and frame of every image that has a pose, and notes."""
    poses, shots, reading = standing_cameras(model)
    others = [name for name in files if name not in shots]
    read = ((name, reading(name)) for name in others if reading)
    further = {name: shot for name, shot in read if shot is not None and shot.camera in poses}
    shots, left_out = shots | further, len(others) - len(further)
    notes = (f"{counted(left_out, 'image')} left out: the COLMAP model has no such pose",) if left_out else ()
    if reading is None and len(poses) > 1:
        notes = (*notes, "every image is a camera of its own at one instant: neither names nor poses show frames")
    return poses, shots, notes

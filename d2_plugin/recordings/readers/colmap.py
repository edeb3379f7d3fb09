"""A recording whose cameras are a COLMAP model: sparse/0 (binary or text) beside images/.

Images are named CAMERA/FRAME.png or CAMERA_FRAME.png. It is enough that one frame of each camera is registered: the
cameras stand still, so further frames on disk share its pose. A model of one still scene from a moving camera becomes
a recording of one instant with a camera per image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.assembly import assembled
from d2_plugin.recordings.cameras.calibration import checked_camera, resized
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.files import FrameFiles, cameras_with_images, common_frames
from d2_plugin.recordings.images import image_size
from d2_plugin.recordings.naming import Reading, Shot, arrange, by_camera, images_below
from d2_plugin.recordings.readers.colmap_model import ColmapImage, ColmapModel, find_model, read_model
from d2_plugin.recordings.recording import Camera, Recording

COLMAP_FPS = 30.0
"""Frame rate that is assumed, with a note: a COLMAP model says nothing about time."""

SAME_POSE = 0.02
"""Poses of one standing camera may differ by this much (radians, and share of the scene's camera spread): bundle
adjustment moves every image by itself."""


def is_colmap(path: Path) -> bool:
    """Whether a COLMAP model lies in `path` or where COLMAP puts one below it."""
    return find_model(path) is not None


def open_colmap(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """Read the COLMAP layout; of the images only headers are opened.

    `cameras` restricts everything to the named ones. Registered cameras whose images are missing are refused by
    name, or left out with a note where `intersect`. Images that are not registered are always left out with a note.
    """
    model = _model(path)
    files = images_below(path / "images")
    poses, shots, notes = _shots(model, files)
    shown = by_camera({name: shot for name, shot in shots.items() if name in files}, files)
    names, missing = cameras_with_images(poses, shown, cameras, intersect, model.folder)
    images = {name: shown[name] for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    calibrated = {name: _camera(name, poses[name], model, images[name], frames) for name in names}
    notes = (*notes, *missing, *frame_notes)
    if len(frames) > 1:
        notes = (*notes, f"a COLMAP model names no frame rate: {COLMAP_FPS:g} taken")
    return assembled(
        path,
        {name: camera for name, (camera, _) in calibrated.items()},
        images,
        frames,
        COLMAP_FPS,
        notes,
        {name: lens for name, (_, lens) in calibrated.items()},
    )


def _model(path: Path) -> ColmapModel:
    folder = find_model(path)
    if folder is None:
        raise D2Error(f"{path} holds no COLMAP model: expected cameras.bin and images.bin (or .txt) in sparse/0")
    return read_model(folder)


def standing_cameras(model: ColmapModel) -> tuple[dict[str, ColmapImage], dict[str, Shot], Reading | None]:
    """One registered image per camera, camera and frame of all of them, and how their names were read."""
    registered = {image.name: image for image in model.images.values()}
    spread = _spread(model.images.values())
    shots, reading = arrange(registered, lambda group: _still([registered[name] for name in group], spread))
    poses: dict[str, ColmapImage] = {}
    for name in sorted(shots, key=lambda name: shots[name].frame):
        poses.setdefault(shots[name].camera, registered[name])
    return dict(sorted(poses.items())), shots, reading


def _shots(model: ColmapModel, files: Iterable[str]) -> tuple[dict[str, ColmapImage], dict[str, Shot], tuple[str, ...]]:
    """One registered image per camera, camera and frame of every image that has a pose, and notes."""
    poses, shots, reading = standing_cameras(model)
    left_out = 0
    for name in files:
        if name not in shots:
            shot = reading(name) if reading else None
            if shot is not None and shot.camera in poses:
                shots[name] = shot
            else:
                left_out += 1
    notes = (f"{left_out} images left out because the COLMAP model has no pose for them",) if left_out else ()
    if reading is None and len(poses) > 1:
        notes = (*notes, "every image is a camera of its own at one instant: neither names nor poses show frames")
    return poses, shots, notes


def _spread(images: Iterable[ColmapImage]) -> float:
    """Largest distance of a camera centre from their mean, world units."""
    centres = np.stack([_centre(image) for image in images])
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def _still(group: list[ColmapImage], spread: float) -> bool:
    """Whether images come from one camera that stands still."""
    first = group[0]
    for image in group[1:]:
        turn = first.T_camera_world[:3, :3] @ image.T_camera_world[:3, :3].T
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
        moved = np.linalg.norm(_centre(image) - _centre(first))
        if angle > SAME_POSE or moved > SAME_POSE * spread + 1e-9:
            return False
    return True


def _centre(image: ColmapImage) -> np.ndarray:
    return -image.T_camera_world[:3, :3].T @ image.T_camera_world[:3, 3]


def _camera(
    name: str, image: ColmapImage, model: ColmapModel, files: FrameFiles, frames: tuple[int, ...]
) -> tuple[Camera, Lens]:
    """The pinhole camera of the undistorted images, and the lens of the recorded ones."""
    where, found = str(model.folder), model.cameras[image.camera]
    size = image_size(files[frames[0]])
    lens = found.lens(where)
    lens = replace(lens, K=resized(lens.K, (found.width, found.height), size, name, where))
    return checked_camera(name, size, lens.pinhole, image.T_camera_world, None, where), lens

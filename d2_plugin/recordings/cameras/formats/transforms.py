"""Instant-NGP's and nerfstudio's transforms.json: poses from camera to world with OpenGL axes, one entry per image.

Intrinsics stand at the top or beside each image. Principal points are taken with the first pixel's centre at 0.5, as
COLMAP, from which nearly all of these files come, writes them. Images of one camera share its pose; Diffuman4D's
`camera_label` names it where there is one. nerfstudio's k3 and k4 multiply r^6 and r^8; OpenCV has no such k4.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import OPENGL_TO_OPENCV, pinhole, rigid
from d2_plugin.recordings.cameras.formats.camera import Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, NUMBER, Document, numbers
from d2_plugin.recordings.naming import arrange

SAME_POSE = 1e-5
"""Largest difference of the matrices of one camera; these files are converted, not estimated per image."""


def recognised(document: Document) -> bool:
    """An object with a list `frames` whose entries have `transform_matrix`."""
    frames = document.json.get("frames") if isinstance(document.json, dict) else None
    first = frames[0] if isinstance(frames, list) and frames else None
    return isinstance(first, dict) and "transform_matrix" in first


def read(document: Document) -> list[Entry]:
    """One camera per pose, under the name that its images give it."""
    content = document.table()
    common = {key: value for key, value in content.items() if key != "frames"}
    listed = [_image(frame, document.place) for frame in content["frames"]]
    named = {str(frame["camera_label"]): (frame, matrix) for frame, matrix in listed if "camera_label" in frame}
    if len(named) < len(listed):  # not one image per camera, which says whose it is
        named = _cameras(listed)
    return [
        read_entry(name, {**common, **frame}, matrix, None, document.place) for name, (frame, matrix) in named.items()
    ]


_Image = tuple[dict[str, Any], np.ndarray]


def _image(frame: Any, place: str) -> _Image:
    """An entry of the list and its pose from camera to world, [4, 4]."""
    if not isinstance(frame, dict):
        raise D2Error(f"an image in {place} is no object: {CORRECT}")
    values = numbers(frame, "transform_matrix", (-1,), f"an image in {place}")
    if values.size not in (12, 16):
        raise D2Error(f"an image in {place} has {values.size} numbers in its matrix, expected 4 x 4: {CORRECT}")
    return frame, np.vstack([values[:12].reshape(3, 4), [0, 0, 0, 1]])


def _cameras(listed: list[_Image]) -> dict[str, _Image]:
    """The first image of each camera, by the camera's name."""
    images = {}
    for number, (frame, matrix) in enumerate(listed):
        images[str(PurePosixPath(str(frame.get("file_path", number))))] = (frame, matrix)
    shots, _ = arrange(images, lambda group: _still([images[name][1] for name in group]))
    found: dict[str, _Image] = {}
    for name in sorted(shots, key=lambda name: shots[name].frame):
        found.setdefault(shots[name].camera, images[name])
    return dict(sorted(found.items()))


def _still(matrices: list[np.ndarray]) -> bool:
    size = max(np.abs(matrices[0]).max(), 1)
    return all(np.abs(matrix - matrices[0]).max() <= SAME_POSE * size for matrix in matrices)


def read_entry(
    name: str, intrinsics: Mapping[str, Any], matrix: np.ndarray, size: tuple[int, int] | None, where: str
) -> Entry:
    """One camera from the keys of an image (and the top), and its pose `matrix` [4, 4] from camera to world.

    `size` (width, height) of its image stands in where the file names none.
    """
    said_by = f"camera {name} in {where}"
    given = {key: field(intrinsics, key, NUMBER, said_by, CORRECT) for key in _NUMBERS if key in intrinsics}
    if size is None and not {"w", "h"} <= given.keys():
        raise D2Error(f"{said_by} has no w and h, the size of its images: add them")
    w, h = size or (1, 1)
    calibrated = (round(given.get("w", w)), round(given.get("h", h)))
    focal = _focal_lengths(given, calibrated, name, where)
    K = pinhole(*focal, given.get("cx", calibrated[0] / 2), given.get("cy", calibrated[1] / 2))
    T_world_camera = matrix @ OPENGL_TO_OPENCV
    rotation = T_world_camera[:3, :3].T  # checked to be orthonormal later
    pose = rigid(rotation, -rotation @ T_world_camera[:3, 3])
    return Entry(name, calibrated, K, *_lens(K, given, str(intrinsics.get("camera_model", "")), said_by), pose)


_NUMBERS = (
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"),
    *("k1", "k2", "k3", "k4", "p1", "p2"),
)


def _focal_lengths(given: dict[str, float], size: tuple[int, int], name: str, where: str) -> tuple[float, float]:
    """Focal lengths in pixels: given as such, or by the angle of view in radians; one of the two serves for both."""
    focal: dict[str, float] = {}
    for axis, length in zip("xy", size):
        if f"fl_{axis}" in given:
            focal[axis] = given[f"fl_{axis}"]
        elif f"camera_angle_{axis}" in given:
            angle = given[f"camera_angle_{axis}"]
            if not 0 < angle < math.pi:
                raise D2Error(
                    f"camera {name} in {where} has camera_angle_{axis} {angle:g}, expected radians: {CORRECT}"
                )
            focal[axis] = length / (2 * math.tan(angle / 2))
    if not focal:
        raise D2Error(f"camera {name} in {where} has neither fl_x nor camera_angle_x: add its focal length in pixels")
    return focal.get("x", focal.get("y", 0.0)), focal.get("y", focal.get("x", 0.0))


def _lens(K: np.ndarray, given: dict[str, float], model: str, where: str) -> tuple[str, tuple[float, ...]]:
    """(model, distortion) as `CalibratedCamera` has them."""
    k1, k2, k3, k4, p1, p2 = (given.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if "FISHEYE" in model.upper():
        return "fisheye", (k1, k2, k3, k4)
    if k4:
        raise D2Error(
            f"{where} has 6 distortion coefficients, of which OpenCV's lens has not the last, k4 of r^8: undistort the "
            "images first"
        )
    return ("opencv", (k1, k2, p1, p2, k3)) if any((k1, k2, p1, p2, k3)) else ("pinhole", ())

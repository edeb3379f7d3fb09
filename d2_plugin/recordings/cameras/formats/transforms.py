"""Instant-NGP's, nerfstudio's and Blender's transforms.json: poses from camera to world with OpenGL axes, per image.

Intrinsics stand at the top or beside each image. Principal points are taken with the first pixel's centre at 0.5, as
COLMAP, from which nearly all of these files come, writes them. Images of one camera share its pose; Diffuman4D's
`camera_label` names it where there is one. nerfstudio's k3 and k4 multiply r^6 and r^8; OpenCV has no such k4.
"""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.camera import OPENGL_TO_OPENCV, CalibratedCamera, pinhole, rigid
from d2_plugin.recordings.cameras.formats.document import CORRECT, NUMBER, Document, Table, has, numbers, object_of
from d2_plugin.recordings.cameras.lens import checked_lens
from d2_plugin.recordings.files import arrange
from d2_plugin.values import shown

SAME_POSE = 1e-5  # largest difference of the matrices of one camera; these files are converted, not estimated per image
TIME_DIGITS = 12  # decimals of a time that count: splits are written by programs that divide in another order

NAMES = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "k2", "k3", "k4", "p1", "p2")
"""Of numbers that describe a camera."""

BENT = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FISHEYE")
STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""What `camera_model` may say; Instant-NGP's own converter says `is_fisheye` instead."""


class ListedImage(NamedTuple):
    """One image of the list `frames`."""

    name: str  # its path as the file has it, without a leading ./
    matrix: np.ndarray  # [4, 4] from camera to world, OpenGL axes
    time: float | None  # of its frame, which it was taken `late` after
    late: float
    table: Table  # what stands beside the image, and at the top of the file where that says nothing else


def listed_images(content: Table, where: str) -> list[ListedImage]:
    """All images that a transforms.json lists."""
    frames = field(content, "frames", list, where, "write one entry per image")
    common = {key: value for key, value in content.items() if key != "frames"}
    return [_listed(frame, common, f"an image in {where}") for frame in frames]


def _listed(frame: Any, common: Table, place: str) -> ListedImage:
    table = object_of(frame, place)
    label = str(table["camera_label"]) if "camera_label" in table else ...
    name = field(table, "file_path", str, place, CORRECT, default=label).removeprefix("./")
    values = numbers(table, "transform_matrix", (-1,), f"{name}, {place},").tolist()
    whole = {"transform_matrix": [*values, 0, 0, 0, 1] if len(values) == 12 else values}
    matrix = numbers(whole, "transform_matrix", (4, 4), f"{name}, {place},")
    late = field(table, "late", NUMBER, place, CORRECT, 0.0)
    time = round(field(table, "time", NUMBER, place, CORRECT) - late, TIME_DIGITS) if "time" in table else None
    return ListedImage(name, matrix, time, late, {**common, **table})


def still(images: list[ListedImage]) -> bool:
    """Whether images were taken from one pose."""
    first = images[0].matrix
    return all(np.abs(one.matrix - first).max() <= SAME_POSE * max(np.abs(first).max(), 1) for one in images)


def read_transforms(document: Document) -> list[CalibratedCamera] | None:
    """One camera per pose, under the label that its image has, or the name that its images give it."""
    if not has(document.table.get("frames"), "transform_matrix"):
        return None
    listed = listed_images(document.table, document.place)
    named = {str(image.table["camera_label"]): image for image in listed if "camera_label" in image.table}
    if len(named) < len(listed):  # not one image per camera, which says whose it is
        images = {str(PurePosixPath(image.name)): image for image in listed}
        shots, _ = arrange(images, lambda group: still([images[name] for name in group]))
        ordered = sorted(shots, key=lambda name: (shots[name].camera, shots[name].frame), reverse=True)
        named = {shots[name].camera: images[name] for name in ordered}  # the first image of each comes last
        named = dict(sorted(named.items()))
    return [camera_of(image, name, None, document.place) for name, image in named.items()]


def camera_of(image: ListedImage, name: str, size: tuple[int, int] | None, where: str) -> CalibratedCamera:
    """The camera that took an image; `size` (width, height) of the image stands in where the file names none."""
    place = f"camera {name} in {where}"
    given = {key: field(image.table, key, NUMBER, place, CORRECT) for key in NAMES if key in image.table}
    if size is None and not {"w", "h"} <= given.keys():
        raise D2Error(f"{place} has no w and h, the size of its images: add them")
    width, height = (round(given.get(key, side)) for key, side in zip("wh", size or (0, 0)))
    fx, fy = _focal_lengths(given, (width, height), place)
    K = pinhole(fx, fy, given.get("cx", width / 2), given.get("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (given.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    said = str(image.table.get("camera_model", "OPENCV_FISHEYE" if image.table.get("is_fisheye") else "OPENCV"))
    if said.upper() not in (*BENT, *STRAIGHT):
        raise D2Error(
            f"{place} has camera_model {shown(said)}, which is none of {', '.join((*STRAIGHT, *BENT))}: give pinhole "
            "images made of it, or leave camera_model out if they are pinhole images already"
        )
    fisheye = said.upper() in BENT
    if k4 and not fisheye:
        raise D2Error(
            f"{place} has 6 distortion coefficients, of which OpenCV's lens has not the last, k4 of r^8: undistort the "
            "images first"
        )
    model, values = ("fisheye", (k1, k2, k3, k4)) if fisheye else ("opencv", (k1, k2, p1, p2, k3))
    T_world_camera = image.matrix @ OPENGL_TO_OPENCV
    rotation = T_world_camera[:3, :3].T  # checked to be orthonormal later
    pose = rigid(rotation, -rotation @ T_world_camera[:3, 3])
    return CalibratedCamera(name, width, height, checked_lens(K, model, values, place), pose)


def _focal_lengths(given: dict[str, float], size: tuple[int, int], place: str) -> tuple[float, float]:
    """Focal lengths in pixels: given as such, or by the angle of view in radians; one of the two serves for both."""
    focal: dict[str, float] = {}
    for axis, length in zip("xy", size):
        if f"fl_{axis}" in given:
            focal[axis] = given[f"fl_{axis}"]
        elif f"camera_angle_{axis}" in given:
            angle = given[f"camera_angle_{axis}"]
            if not 0 < angle < math.pi:
                raise D2Error(f"{place} has camera_angle_{axis} {angle:g}, expected radians: {CORRECT}")
            focal[axis] = length / (2 * math.tan(angle / 2))
    if not focal:
        raise D2Error(f"{place} has neither fl_x nor camera_angle_x: add its focal length in pixels")
    return focal.get("x", focal.get("y", 0.0)), focal.get("y", focal.get("x", 0.0))

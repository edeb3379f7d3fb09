"""Kalibr's camchain.yaml: cam0, cam1, ... where each pose says where the camera before it stands.

`T_cn_cnm1` maps points of camera N - 1 to camera N, and the world is camera 0's. Cameras with the model `pinhole` are
read, with `radtan` (OpenCV's k1 k2 p1 p2), `equidistant` (OpenCV's fisheye) or no distortion. Metres.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import pinhole
from d2_plugin.recordings.cameras.formats.camera import OPENCV_CENTRE, Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document, numbers, size_of

DISTORTIONS = {"radtan": ("opencv", 4), "equidistant": ("fisheye", 4), "none": ("pinhole", 0)}
"""Kalibr's name -> model and number of coefficients."""

_NAME = re.compile(r"cam(\d+)$")


def recognised(document: Document) -> bool:
    """Tables cam0, cam1, ... with `camera_model` and `intrinsics`."""
    first = document.yaml.get("cam0") if isinstance(document.yaml, dict) else None
    return isinstance(first, dict) and "camera_model" in first and "intrinsics" in first


def read(document: Document) -> list[Entry]:
    """The cameras, with the poses multiplied along the chain."""
    tables = {name: table for name, table in document.table().items() if _NAME.match(str(name))}
    ordered = sorted(tables, key=lambda name: int(name[3:]))
    pose, found = np.eye(4), []
    for number, name in enumerate(ordered):
        place = f"{name} in {document.place}"
        if not isinstance(tables[name], dict) or name != f"cam{number}":
            raise D2Error(f"{place} is out of the chain, expected cam{number} there: {CORRECT}")
        if number:
            pose = _checked_link(numbers(tables[name], "T_cn_cnm1", (4, 4), place), place) @ pose
        found.append(_entry(tables[name], name, pose, place))
    return found


def _checked_link(link: np.ndarray, place: str) -> np.ndarray:
    if not np.allclose(link[3], [0, 0, 0, 1]):
        raise D2Error(f"T_cn_cnm1 of {place} ends with the row {link[3].tolist()}, expected 0 0 0 1: {CORRECT}")
    return link


def _entry(table: dict[str, Any], name: str, pose: np.ndarray, place: str) -> Entry:
    model = field(table, "camera_model", str, place, CORRECT)
    if model != "pinhole":
        raise D2Error(
            f"{place} has the camera model {model}, which cannot be undistorted here: calibrate it with Kalibr's "
            "pinhole-equi or pinhole-radtan"
        )
    distortion = field(table, "distortion_model", str, place, CORRECT, default="none")
    if distortion not in DISTORTIONS:
        raise D2Error(
            f"{place} has the distortion model {distortion}, expected {', '.join(DISTORTIONS)}: calibrate it with "
            "Kalibr's pinhole-equi or pinhole-radtan"
        )
    fx, fy, cx, cy = numbers(table, "intrinsics", (4,), place)
    name_here, count = DISTORTIONS[distortion]
    coefficients = numbers(table, "distortion_coeffs", (count,), place) if count else np.zeros(0)
    K = pinhole(fx, fy, cx + OPENCV_CENTRE, cy + OPENCV_CENTRE)
    return Entry(name, size_of(table, "resolution", place), K, name_here, tuple(coefficients.tolist()), pose)

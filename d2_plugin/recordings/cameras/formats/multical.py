"""Multical's calibration.json: intrinsics under `cameras`, poses from the rig to each camera under `camera_poses`.

Where a master camera was chosen, poses are called "camera_to_master". The unit is that of the board.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import rigid
from d2_plugin.recordings.cameras.formats.camera import OPENCV_CENTRE, Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document, numbers, size_of

MODELS = ("standard", "rational", "thin_prism", "tilted", "opencv")
"""Multical's camera models, all of which are OpenCV's vector at different lengths."""


def recognised(document: Document) -> bool:
    """An object with `cameras` and `camera_poses`."""
    return isinstance(document.json, dict) and all(
        isinstance(document.json.get(key), dict) for key in ("cameras", "camera_poses")
    )


def read(document: Document) -> list[Entry]:
    """The cameras that have a pose, in the order of the file."""
    content = document.table()
    return [_entry(name, table, content["camera_poses"], document.place) for name, table in content["cameras"].items()]


def _entry(name: str, table: Any, poses: Mapping[str, Any], document: str) -> Entry:
    place = f"camera {name} in {document}"
    if not isinstance(table, dict):
        raise D2Error(f"{place} is no object: {CORRECT}")
    K = numbers(table, "K", (3, 3), place)
    K[:2, 2] += OPENCV_CENTRE
    distortion = numbers(table, "dist", (-1,), place) if "dist" in table else np.zeros(0)
    model = field(table, "model", str, place, CORRECT, default="standard")
    if model not in (*MODELS, "fisheye"):
        raise D2Error(f"{place} has the model {model}, expected {', '.join(MODELS)} or fisheye: {CORRECT}")
    found = "fisheye" if model == "fisheye" else "opencv"
    size, pose = size_of(table, "image_size", place), _pose(name, poses, place)
    return Entry(name, size, K, found, tuple(np.ravel(distortion).tolist()), pose)


def _pose(name: str, poses: Mapping[str, Any], place: str) -> np.ndarray:
    keys = [key for key in poses if key == name or key.startswith(f"{name}_to_")]
    if len(keys) != 1 or not isinstance(poses[keys[0]], dict):
        raise D2Error(f"{place} has {len(keys)} poses in camera_poses, expected one: calibrate it again or remove it")
    pose = poses[keys[0]]
    return rigid(numbers(pose, "R", (3, 3), place), numbers(pose, "T", (3,), place))

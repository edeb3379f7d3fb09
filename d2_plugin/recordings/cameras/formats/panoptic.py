"""CMU Panoptic Studio's calibration_SEQUENCE.json: K, distCoef, R and t of each camera, in centimetres.

The distortion is OpenCV's k1 k2 p1 p2 k3. The file lists hundreds of cameras: HD, VGA and Kinect; give the recordings
to choose among them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import rigid
from d2_plugin.recordings.cameras.formats.camera import OPENCV_CENTRE, Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document, numbers, size_of

METRES = 0.01
"""Of a unit of the file."""


def recognised(document: Document) -> bool:
    """An object with a list `cameras` whose entries have `K`, `distCoef` and `resolution`."""
    cameras = document.json.get("cameras") if isinstance(document.json, dict) else None
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and {"K", "distCoef", "resolution"} <= first.keys()


def read(document: Document) -> list[Entry]:
    """The cameras, in metres."""
    return [_entry(table, document.place) for table in document.table()["cameras"]]


def _entry(table: Any, document: str) -> Entry:
    if not isinstance(table, dict):
        raise D2Error(f"a camera in {document} is no object: {CORRECT}")
    name = field(table, "name", str, f"a camera in {document}", CORRECT)
    place = f"camera {name} in {document}"
    K = numbers(table, "K", (3, 3), place)
    K[:2, 2] += OPENCV_CENTRE
    distortion = numbers(table, "distCoef", (-1,), place)
    pose = rigid(numbers(table, "R", (3, 3), place), METRES * numbers(table, "t", (3,), place))
    return Entry(name, size_of(table, "resolution", place), K, "opencv", tuple(np.ravel(distortion).tolist()), pose)

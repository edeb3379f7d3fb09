"""Calibrations in TOML: Pose2Sim (and OpenCap through it), Caliscope, Anipose and FreeMoCap.

All have a table per camera with `size` [w, h], `matrix` [3, 3], `distortions`, `rotation` (a rotation vector, or a
matrix in older Caliscope files) and `translation`, from world to camera, with OpenCV's axes and pixel centres.
Pose2Sim is in metres, Caliscope in metres, Anipose in the unit of its board.
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
from d2_plugin.recordings.cameras.rotations import rotation_of_vector

OPENCV_LENGTHS = (0, 1, 2, 4, 5, 8, 12, 14)
"""Coefficients that OpenCV's vector of distortions may have; aniposelib also writes k1 alone, and k1 k2."""


def _tables(document: Document) -> dict[str, dict[str, Any]]:
    """The tables that describe cameras."""
    found = document.toml or {}
    return {name: table for name, table in found.items() if isinstance(table, dict) and "matrix" in table}


def is_caliscope(document: Document) -> bool:
    """camera_array.toml: tables [cameras.0], [cameras.1], ... (older: [cam_0] with a `port`)."""
    cameras = (document.toml or {}).get("cameras")
    nested = cameras.values() if isinstance(cameras, dict) else ()
    return any(isinstance(table, dict) and "matrix" in table for table in nested) or any(
        "port" in table for table in _tables(document).values()
    )


def is_pose2sim(document: Document) -> bool:
    """Calib*.toml: tables whose `distortions` are k1 k2 p1 p2, and [metadata] with `adjusted`."""
    tables = _tables(document)
    metadata = (document.toml or {}).get("metadata")
    marked = isinstance(metadata, dict) and "adjusted" in metadata
    four = all(_length(table) == 4 for table in tables.values())
    return bool(tables) and four and marked


def is_anipose(document: Document) -> bool:
    """calibration.toml: tables [cam_0], [cam_1], ..."""
    return bool(_tables(document))


def _length(table: Mapping[str, Any]) -> int:
    values = table.get("distortions")
    return len(values) if isinstance(values, list) else -1


def read_tables(document: Document) -> list[Entry]:
    """The cameras of Pose2Sim and Anipose, in the order of the file."""
    return [_entry(table, str(table.get("name", key)), document.place) for key, table in _tables(document).items()]


def read_caliscope(document: Document) -> list[Entry]:
    """The cameras of Caliscope, called cam_N as its videos are.

    Raises:
        D2Error: a camera without a pose, which Caliscope writes for cameras that it could not place.
    """
    nested = (document.toml or {}).get("cameras")
    tables = nested if isinstance(nested, dict) else _tables(document)
    found = []
    for key, table in tables.items():
        if not isinstance(table, dict) or table.get("ignore") is True:
            continue
        number = table.get("cam_id", table.get("port", key))
        name = str(number) if str(number).startswith("cam") else f"cam_{number}"
        missing = [part for part in ("matrix", "rotation", "translation") if part not in table]
        if missing:
            raise D2Error(
                f"camera {name} in {document.place} has no {' and no '.join(missing)}: Caliscope could not place it; "
                "calibrate it or remove its table"
            )
        found.append(_entry(table, name, document.place))
    return found


def _entry(table: Mapping[str, Any], name: str, document: str) -> Entry:
    place = f"camera {name} in {document}"
    matrix = numbers(table, "matrix", (3, 3), place)
    matrix[:2, 2] += OPENCV_CENTRE
    values = numbers(table, "distortions", (-1,), place) if "distortions" in table else np.zeros(0)
    fisheye = field(table, "fisheye", bool, place, CORRECT, default=False)
    if fisheye and len(values) == 5 and values[4] == 0:
        values = values[:4]  # a fisheye written in the place of five coefficients
    if len(values) not in ((0, 4) if fisheye else OPENCV_LENGTHS):
        raise D2Error(f"{place} has {len(values)} distortions, expected 4 or 5 (a fisheye 4): {CORRECT}")
    pose = rigid(_rotation(table, place), numbers(table, "translation", (3,), place))
    model = "fisheye" if fisheye else "opencv"
    return Entry(name, size_of(table, "size", place), matrix, model, tuple(values.tolist()), pose)


def _rotation(table: Mapping[str, Any], place: str) -> np.ndarray:
    values = numbers(table, "rotation", (-1,), place)
    if values.size == 9:
        return values.reshape(3, 3)
    return rotation_of_vector(numbers(table, "rotation", (3,), place))

"""This project's own cameras.json, as the folder layout has it.

{"cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy", "R", "t", "model"?, "distortion"?}], "fps", "bounds"}
with OpenCV axes, x_cam = R X + t and the centre of pixel i at i + 0.5. `model` is one of `MODELS`, pinhole where
nothing is said; with another one the images are undistorted when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Union

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import pinhole, rigid
from d2_plugin.recordings.cameras.formats.camera import MODELS, CalibratedCamera, Entry
from d2_plugin.recordings.cameras.formats.document import CORRECT, NUMBER, Document, numbers
from d2_plugin.values import shown


def recognised(document: Document) -> bool:
    """An object with a list `cameras` whose entries have `fx` and `R`."""
    cameras = document.json.get("cameras") if isinstance(document.json, dict) else None
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and {"fx", "R", "t"} <= first.keys()


def read(document: Document) -> list[Entry]:
    """The cameras, in the order of the file."""
    return [read_entry(entry, document.place) for entry in document.table()["cameras"]]


def read_entry(entry: Any, path: str) -> Entry:
    """One camera of the list in the file `path`."""
    if not isinstance(entry, dict):
        raise D2Error(f"a camera in {path} cannot be understood ({shown(entry)} is no object): {CORRECT}")
    name = str(field(entry, "name", Union[str, int], f"a camera in {path}", CORRECT))  # noqa: UP007
    where = f"camera {name} in {path}"
    K = pinhole(*(field(entry, key, NUMBER, where, CORRECT) for key in ("fx", "fy", "cx", "cy")))
    size = (field(entry, "width", int, where, CORRECT), field(entry, "height", int, where, CORRECT))
    pose = rigid(numbers(entry, "R", (3, 3), where), numbers(entry, "t", (3,), where))
    model = field(entry, "model", str, where, CORRECT, default="pinhole")
    if model not in MODELS:
        raise unknown_name(f"camera model of {where}", model, MODELS)
    distortion = numbers(entry, "distortion", (-1,), where) if "distortion" in entry else np.zeros(0)
    if model == "pinhole" and distortion.any():
        raise D2Error(f"{where} has a distortion but no model: add one of {', '.join(MODELS[1:])} as `model`")
    return Entry(name, size, K, model, tuple(distortion.tolist()), pose)


def to_json(cameras: Sequence[CalibratedCamera]) -> list[dict[str, Any]]:
    """The list `cameras` that `read` understands, lenses included; R and t are in the unit of the cameras.

    Raises:
        D2Error: a camera with skew, which the layout cannot say.
    """
    return [_written(camera) for camera in cameras]


def _written(camera: CalibratedCamera) -> dict[str, Any]:
    K = camera.matrix
    if K[0, 1] != 0:
        raise D2Error(f"camera {camera.name} has skew {K[0, 1]:g}, which no layout holds: undistort its images first")
    entry: dict[str, Any] = {"name": camera.name, "width": camera.width, "height": camera.height}
    entry |= {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    entry |= {"R": camera.rotation.tolist(), "t": camera.translation.tolist()}
    if camera.model != "pinhole":
        entry |= {"model": camera.model, "distortion": list(camera.distortion)}
    return entry

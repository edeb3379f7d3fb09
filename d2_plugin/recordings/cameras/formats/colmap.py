"""COLMAP's models, binary and text, and its rig_config.json.

A model is a folder with cameras and images, or the reconstruction's folder above it (sparse/0). Its rigs.bin and
frames.bin are not needed: images carry the poses that follow from them. Images CAMERA/FRAME.png of one pose are one
camera. Its scale is arbitrary. rig_config.json has the pose of each camera of a rig, whose axes are the world's here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.calibration import rigid
from d2_plugin.recordings.cameras.formats.camera import Entry, of_lens
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document, numbers
from d2_plugin.recordings.cameras.rotations import rotation_of_quaternion
from d2_plugin.recordings.readers.colmap import standing_cameras
from d2_plugin.recordings.readers.colmap_model import MODELS, ColmapCamera, find_model, read_model


def is_model(document: Document) -> bool:
    """A folder with cameras.bin and images.bin (or .txt), or with such a folder in sparse/0."""
    return document.path.is_dir() and find_model(document.path) is not None


def read_model_folder(document: Document) -> list[Entry]:
    """The cameras that stand still, by name; several images of one camera are one."""
    model = read_model(find_model(document.path) or document.path)
    poses, _, _ = standing_cameras(model)
    return [
        _entry(name, model.cameras[image.camera], image.T_camera_world, f"camera {name} in {model.folder}")
        for name, image in poses.items()
    ]


def _entry(name: str, camera: ColmapCamera, pose: np.ndarray, where: str) -> Entry:
    lens = camera.lens(where)
    return Entry(name, (camera.width, camera.height), lens.K, *of_lens(lens), pose)


def is_rig(document: Document) -> bool:
    """A list of rigs whose cameras have an `image_prefix`."""
    rigs = document.json
    cameras = rigs[0].get("cameras") if isinstance(rigs, list) and rigs and isinstance(rigs[0], dict) else None
    return isinstance(cameras, list) and bool(cameras) and isinstance(cameras[0], dict) and "image_prefix" in cameras[0]


def read_rig(document: Document) -> list[Entry]:
    """The cameras of the one rig in the file; it names no sizes of images."""
    if len(document.json) != 1:
        raise D2Error(f"{document.place} has {len(document.json)} rigs, expected one: split the file")
    return [_rig_entry(table, document.place) for table in document.json[0]["cameras"]]


def _rig_entry(table: Any, document: str) -> Entry:
    if not isinstance(table, dict):
        raise D2Error(f"a camera in {document} is no object: {CORRECT}")
    prefix = field(table, "image_prefix", str, f"a camera in {document}", CORRECT)
    name = prefix.strip("/").rpartition("/")[2]
    place = f"camera {name} in {document}"
    model = field(table, "camera_model_name", str, place, _NO_LENS)
    parameters = numbers(table, "camera_params", (-1,), place) if "camera_params" in table else None
    if parameters is None or model not in dict(MODELS):
        raise D2Error(f"{place} has the model {model} and no parameters that go with it: {_NO_LENS}")
    lens = ColmapCamera(model, 1, 1, tuple(parameters.tolist())).lens(place)
    return Entry(name, None, lens.K, *of_lens(lens), _rig_pose(table, place))


_NO_LENS = "add camera_model_name and camera_params, or give the model that COLMAP made with the rig"


def _rig_pose(table: dict[str, Any], place: str) -> np.ndarray:
    if field(table, "ref_sensor", bool, place, CORRECT, default=False):
        return np.eye(4)
    try:
        rotation = rotation_of_quaternion(numbers(table, "cam_from_rig_rotation", (4,), place))
    except D2Error:
        raise
    except ValueError as failure:
        raise D2Error(f"{place} has a rotation that is none ({failure}): {CORRECT}") from None
    return rigid(rotation, numbers(table, "cam_from_rig_translation", (3,), place))

"""Calibrations of Pose2Sim, Caliscope, Anipose, Kalibr, Multical, CMU Panoptic, Qualisys and OpenCV's own programs.

All of them give a K for pixels whose first centre lies at 0 (of Qualisys, Pose2Sim takes it so) and OpenCV's
coefficients; all but Qualisys a pose from world to camera.
"""

from __future__ import annotations

from typing import Any, Optional
from xml.etree.ElementTree import Element

import numpy as np

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.camera import OPENCV_CENTRE, CalibratedCamera, pinhole, rigid
from d2_plugin.recordings.cameras.formats.document import (
    CORRECT,
    Document,
    Table,
    coefficients,
    has,
    matrix_of,
    numbers,
    object_of,
    size_of,
)
from d2_plugin.recordings.cameras.lens import checked_lens
from d2_plugin.recordings.cameras.rotations import rotation_of_vector

Cameras = Optional[list[CalibratedCamera]]  # noqa: UP045  at run time, on Python 3.9 too

CENTIMETRES = 0.01  # of the positions in CMU Panoptic's files, in metres

SUBPIXELS, MILLIMETRES = 64, 0.001  # of lengths and of positions in Qualisys' files

KALIBR_DISTORTIONS = {"radtan": ("opencv", 4), "equidistant": ("fisheye", 4), "none": ("pinhole", 0)}
"""Kalibr's name -> model and number of coefficients."""

MULTICAL_MODELS = ("standard", "rational", "thin_prism", "tilted", "opencv", "fisheye")
"""All but the last are OpenCV's vector at different lengths."""

TOML_LENGTHS = (0, 1, 2, 4, 5, 8, 12, 14)
"""Coefficients that OpenCV's vector of distortions may have; aniposelib also writes k1 alone, and k1 k2."""


def _camera(
    name: str,
    place: str,
    size: tuple[int, int],
    K: np.ndarray,
    model: str,
    distortion: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> CalibratedCamera:
    """A camera whose first pixel has its centre at 0 in `K`."""
    K = K + [[0, 0, OPENCV_CENTRE], [0, 0, OPENCV_CENTRE], [0, 0, 0]]
    return CalibratedCamera(name, *size, checked_lens(K, model, distortion, place), rigid(rotation, translation))


def read_caliscope(document: Document) -> Cameras:
    """camera_array.toml: tables [cameras.0], [cameras.1], ... (older: [cam_0] with a `port`), called cam_N.

    Raises:
        D2Error: a camera without a pose, which Caliscope writes for cameras that it could not place.
    """
    nested = document.table.get("cameras")
    tables = nested if isinstance(nested, dict) else _toml_tables(document)
    known = [table for table in tables.values() if isinstance(table, dict) and "matrix" in table]
    if not known or (tables is not nested and not any("port" in table for table in known)):
        return None
    cameras = []
    for key, table in tables.items():
        if not isinstance(table, dict) or table.get("ignore") is True:
            continue
        number = str(table.get("cam_id", table.get("port", key)))
        name = number if number.startswith("cam") else f"cam_{number}"
        missing = [part for part in ("matrix", "rotation", "translation") if part not in table]
        if missing:
            raise D2Error(
                f"camera {name} in {document.place} has no {' and no '.join(missing)}: Caliscope could not place it; "
                "calibrate it or remove its table"
            )
        cameras.append(_toml_camera(table, name, document.place))
    return cameras


def read_pose2sim(document: Document) -> Cameras:
    """Calib*.toml: tables whose `distortions` are k1 k2 p1 p2, and [metadata] with `adjusted`."""
    tables, metadata = _toml_tables(document), document.table.get("metadata")
    marked = isinstance(metadata, dict) and "adjusted" in metadata
    lengths = [len(d) if isinstance(d := table.get("distortions"), list) else -1 for table in tables.values()]
    return read_anipose(document) if marked and set(lengths) == {4} else None


def read_anipose(document: Document) -> Cameras:
    """calibration.toml: tables [cam_0], [cam_1], ... with `matrix`, in the unit of the board."""
    tables = _toml_tables(document)
    return [_toml_camera(table, str(table.get("name", key)), document.place) for key, table in tables.items()] or None


def _toml_tables(document: Document) -> dict[str, Table]:
    return {name: table for name, table in document.table.items() if isinstance(table, dict) and "matrix" in table}


def _toml_camera(table: Table, name: str, document: str) -> CalibratedCamera:
    place = f"camera {name} in {document}"
    values = coefficients(table, "distortions", place)
    fisheye = field(table, "fisheye", bool, place, CORRECT, default=False)
    if fisheye and len(values) == 5 and values[4] == 0:
        values = values[:4]  # a fisheye written in the place of five coefficients
    if len(values) not in ((0, 4) if fisheye else TOML_LENGTHS):
        raise D2Error(f"{place} has {len(values)} distortions, expected 4 or 5 (a fisheye 4): {CORRECT}")
    rotation = numbers(table, "rotation", (-1,), place)
    if rotation.size != 9:  # older files of Caliscope have the matrix
        rotation = rotation_of_vector(numbers(table, "rotation", (3,), place))
    K, translation = numbers(table, "matrix", (3, 3), place), numbers(table, "translation", (3,), place)
    model, size = "fisheye" if fisheye else "opencv", size_of(table, "size", place)
    return _camera(name, place, size, K, model, values, rotation.reshape(3, 3), translation)


def read_kalibr(document: Document) -> Cameras:
    """camchain.yaml: cam0, cam1, ... whose `T_cn_cnm1` maps points of the camera before to this one; metres.

    The world is camera 0's. Cameras of the model `pinhole` are read, with radtan, equidistant or no distortion.
    """
    if not has([document.table.get("cam0")], "camera_model", "intrinsics"):
        return None
    tables = {name: table for name, table in document.table.items() if name[:3] == "cam" and name[3:].isdecimal()}
    pose, cameras = np.eye(4), []
    for number, name in enumerate(sorted(tables, key=lambda name: int(name[3:]))):
        place = f"{name} in {document.place}"
        table = object_of(tables[name], place)
        if name != f"cam{number}":
            raise D2Error(f"{place} is out of the chain, expected cam{number} there: {CORRECT}")
        if number:
            pose = numbers(table, "T_cn_cnm1", (4, 4), place) @ pose
        cameras.append(_kalibr_camera(table, name, pose, place))
    return cameras


def _kalibr_camera(table: Table, name: str, pose: np.ndarray, place: str) -> CalibratedCamera:
    remedy = "calibrate it with Kalibr's pinhole-equi or pinhole-radtan"
    model = field(table, "camera_model", str, place, CORRECT)
    if model != "pinhole":
        raise D2Error(f"{place} has the camera model {model}, which cannot be undistorted here: {remedy}")
    distortion = field(table, "distortion_model", str, place, CORRECT, default="none")
    if distortion not in KALIBR_DISTORTIONS:
        raise D2Error(
            f"{place} has the distortion model {distortion}, expected {', '.join(KALIBR_DISTORTIONS)}: {remedy}"
        )
    model, count = KALIBR_DISTORTIONS[distortion]
    values = numbers(table, "distortion_coeffs", (count,), place) if count else np.zeros(0)
    K, size = pinhole(*numbers(table, "intrinsics", (4,), place)), size_of(table, "resolution", place)
    return _camera(name, place, size, K, model, values, pose[:3, :3], pose[:3, 3])


def read_multical(document: Document) -> Cameras:
    """calibration.json: intrinsics under `cameras`, poses from the rig to each camera under `camera_poses`.

    Where a master camera was chosen, poses are called "camera_to_master". The unit is that of the board.
    """
    cameras, poses = document.table.get("cameras"), document.table.get("camera_poses")
    if not isinstance(cameras, dict) or not isinstance(poses, dict):
        return None
    return [_multical_camera(name, table, poses, document.place) for name, table in cameras.items()]


def _multical_camera(name: str, entry: Any, poses: Table, document: str) -> CalibratedCamera:
    place = f"camera {name} in {document}"
    table = object_of(entry, place)
    model = field(table, "model", str, place, CORRECT, default="standard")
    refuse_unknown(f"model of {place}", [model], MULTICAL_MODELS)
    keys = [key for key in poses if key == name or key.startswith(f"{name}_to_")]
    if len(keys) != 1 or not isinstance(poses[keys[0]], dict):
        raise D2Error(f"{place} has {len(keys)} poses in camera_poses, expected one: calibrate it again or remove it")
    pose, K = poses[keys[0]], numbers(table, "K", (3, 3), place)
    rotation, translation = numbers(pose, "R", (3, 3), place), numbers(pose, "T", (3,), place)
    model, distortion = "fisheye" if model == "fisheye" else "opencv", coefficients(table, "dist", place)
    return _camera(name, place, size_of(table, "image_size", place), K, model, distortion, rotation, translation)


def read_panoptic(document: Document) -> Cameras:
    """calibration_SEQUENCE.json of CMU's Panoptic Studio: hundreds of cameras (HD, VGA, Kinect), in centimetres."""
    if not has(document.cameras(), "K", "distCoef", "resolution"):
        return None
    cameras = []
    for entry in document.cameras():
        place = f"a camera in {document.place}"
        table = object_of(entry, place)
        name = field(table, "name", str, place, CORRECT)
        place = f"camera {name} in {document.place}"
        K, distortion = numbers(table, "K", (3, 3), place), numbers(table, "distCoef", (-1,), place)
        R, t = numbers(table, "R", (3, 3), place), CENTIMETRES * numbers(table, "t", (3,), place)
        cameras.append(_camera(name, place, size_of(table, "resolution", place), K, "opencv", distortion, R, t))
    return cameras


def read_qualisys(document: Document) -> Cameras:
    """QTM's .qca.txt: XML with lengths in 64ths of a pixel of the sensor and positions in millimetres.

    Rows of the rotation are the camera's axes, x right, y up, z backward. Coefficients are those of OpenCV, not scaled.
    """
    if document.xml is None or document.xml.tag != "calibration":
        return None
    cameras = []
    for entry in document.xml.findall("cameras/camera"):
        name = entry.get("serial", "without serial")
        place = f"camera {name} in {document.place}"
        if entry.get("active") == "0":
            continue

        def given(part: str, *keys: str, entry: Element = entry, place: str = place) -> np.ndarray:
            found = entry.find(part)
            values = {} if found is None else found.attrib
            missing = [key for key in keys if key not in values]
            if missing:
                raise D2Error(f"{place} has no {missing[0]} of its {part}: {CORRECT}")
            return numbers({part: [values[key] for key in keys]}, part, (len(keys),), place)

        left, top, right, bottom = given("fov_video", "left", "top", "right", "bottom")
        size = size_of({"fov_video": [right - left + 1, bottom - top + 1]}, "fov_video", place)
        fx, fy, cx, cy = given("intrinsic", "focalLengthU", "focalLengthV", "centerPointU", "centerPointV") / SUBPIXELS
        radial = given("intrinsic", *(f"radialDistortion{n}" for n in (1, 2, 3)))
        tangential = given("intrinsic", "tangentalDistortion1", "tangentalDistortion2")
        R = given("transform", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3) * [[1], [-1], [-1]]
        t = -R @ (MILLIMETRES * given("transform", "x", "y", "z"))
        lens = np.array([*radial[:2], *tangential, radial[2]])
        cameras.append(_camera(name, place, size, pinhole(fx, fy, cx - left, cy - top), "opencv", lens, R, t))
    return cameras


def read_opencv(document: Document) -> Cameras:
    """XML and YAML of OpenCV's programs: `stereo_calib` (M1 D1 M2 D2 of intrinsics, R T of extrinsics, from the first
    camera to the second; in two files or one) and the multi-camera calibration of ccalib. Neither names sizes."""
    path, table, place = document.path, document.opencv, document.place
    beside = {"intrinsics": "extrinsics", "extrinsics": "intrinsics"}.get(path.stem)
    if beside and path.with_stem(beside).is_file():
        table = table | Document(path.with_stem(beside)).opencv
    poses = {"1": np.eye(4)}
    if {"M1", "M2", "R", "T"} <= table.keys():
        poses["2"] = rigid(matrix_of(table, "R", (3, 3), place), matrix_of(table, "T", (3,), place))
        names = "M{}", "D{}"
    elif "camera_matrix_0" in table and not any(key.startswith("xi_") for key in table):
        numbered = (key.removeprefix("camera_matrix_") for key in table if key.startswith("camera_matrix_"))
        poses = {number: matrix_of(table, f"camera_pose_{number}", (4, 4), place) for number in numbered}
        names = "camera_matrix_{}", "camera_distortion_{}"
    else:
        return None
    cameras = []
    for number, pose in poses.items():
        K = matrix_of(table, names[0].format(number), (3, 3), place)
        distortion = matrix_of(table, names[1].format(number), (-1,), place)
        lens = (K, "opencv", distortion, pose[:3, :3], pose[:3, 3])
        cameras.append(_camera(f"cam{number}", f"camera {number} in {place}", (0, 0), *lens))
    return cameras

"""EasyMocap's and EasyVolcap's intri.yml and extri.yml, both in OpenCV's YAML.

intri.yml: K_<camera>, D_<camera> or dist_<camera>, and perhaps W_<camera> and H_<camera>; extri.yml: R_<camera>
(rotation vector) or Rot_<camera> (matrix) and T_<camera>, mapping world to camera. Their tools are OpenCV's, so the
first pixel has its centre at 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.camera import OPENCV_CENTRE, CalibratedCamera, rigid
from d2_plugin.recordings.cameras.formats.document import Document, Table, matrix_of, numbers
from d2_plugin.recordings.cameras.lens import checked_lens
from d2_plugin.recordings.cameras.rotations import rotation_of_vector

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


def read_easymocap(document: Document) -> list[CalibratedCamera] | None:
    """A folder with both files, or one of the two beside the other."""
    folder = document.path if document.path.is_dir() else document.path.parent
    named = document.path.is_dir() or document.path.name in (INTRINSICS, EXTRINSICS)
    if not named or not all((folder / name).is_file() for name in (INTRINSICS, EXTRINSICS)):
        return None
    return read_rig(folder)


def read_rig(folder: Path) -> list[CalibratedCamera]:
    """The cameras that both files describe, in the order of extri.yml; of size 0 where no size is named.

    The published files give the intrinsics of more cameras than they give poses of: those are left out.
    """
    intrinsics, extrinsics = (_read(folder / name) for name in (INTRINSICS, EXTRINSICS))
    listed = [*_names(extrinsics, "T_"), *_names(intrinsics, "K_")]
    both = [name for name in dict.fromkeys(listed) if f"K_{name}" in intrinsics and f"T_{name}" in extrinsics]
    if not both:
        raise D2Error(
            f"{folder} has no camera with intrinsics K_ in {INTRINSICS} and a pose T_ in {EXTRINSICS}: add it"
        )
    return [_camera(name, intrinsics, extrinsics, folder) for name in both]


def _read(path: Path) -> Table:
    content = Document(path).opencv
    if not content:
        raise D2Error(f"{path} is not a YAML file of OpenCV's, which begins with %YAML: restore the file")
    return content


def _names(table: Table, prefix: str) -> list[str]:
    """The list `names`, or the cameras that entries are called after."""
    listed = table.get("names")
    entries = [key.removeprefix(prefix) for key in table if key.startswith(prefix)]
    return [str(name) for name in listed] if isinstance(listed, list) else entries


def _camera(name: str, intrinsics: Table, extrinsics: Table, folder: Path) -> CalibratedCamera:
    where = f"{folder / INTRINSICS} and {EXTRINSICS}"
    K = matrix_of(intrinsics, f"K_{name}", (3, 3), where)
    K[:2, 2] += OPENCV_CENTRE
    bent = next((key for key in (f"D_{name}", f"dist_{name}") if key in intrinsics), None)
    lens = checked_lens(
        K, "opencv", () if bent is None else matrix_of(intrinsics, bent, (-1,), where), f"camera {name} in {where}"
    )
    width, height = _pair(intrinsics, f"W_{name}", f"H_{name}", where) or (0, 0)
    near_far = _pair(extrinsics, f"n_{name}", f"f_{name}", where)
    translation = matrix_of(extrinsics, f"T_{name}", (3,), where)
    pose = rigid(_rotation(name, extrinsics, where), translation)
    return CalibratedCamera(name, round(width), round(height), lens, pose, near_far)


def _rotation(name: str, extrinsics: Table, where: str) -> np.ndarray:
    """The rotation vector is preferred, as the layout's own readers do."""
    if f"R_{name}" in extrinsics:
        return rotation_of_vector(matrix_of(extrinsics, f"R_{name}", (3,), where))
    if f"Rot_{name}" not in extrinsics:
        raise D2Error(f"{where} have neither R_{name} nor Rot_{name}: add the rotation of camera {name}")
    return matrix_of(extrinsics, f"Rot_{name}", (3, 3), where)


def _pair(table: Table, one: str, other: str, where: str) -> tuple[float, float] | None:
    """Two numbers that stand by themselves, None where one of them is not there."""
    if one not in table or other not in table:
        return None
    first, second = numbers({one: [table[one], table[other]]}, one, (2,), where)
    return float(first), float(second)

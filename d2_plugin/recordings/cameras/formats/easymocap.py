"""EasyMocap's and EasyVolcap's intri.yml and extri.yml, both in OpenCV's YAML.

intri.yml: K_<camera>, D_<camera> or dist_<camera>, and perhaps W_<camera> and H_<camera>; extri.yml: R_<camera>
(rotation vector) or Rot_<camera> (matrix) and T_<camera>, mapping world to camera. Their tools are OpenCV's, so the
first pixel has its centre at 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, read_text
from d2_plugin.recordings.cameras.calibration import LARGEST_NUMBER, rigid
from d2_plugin.recordings.cameras.formats.camera import OPENCV_CENTRE, Entry
from d2_plugin.recordings.cameras.formats.document import Document
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.images import opencv

LARGEST_MATRIX = 64
"""Rows and columns of a calibration's matrices, at most."""

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


class OpencvYaml:
    """The entries of one file of OpenCV's FileStorage."""

    def __init__(self, path: Path) -> None:
        self.path = path
        cv2 = opencv("reading OpenCV's YAML files")
        flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
        text = read_text(path)
        if "\0" in text or not text.startswith("%YAML"):
            raise D2Error(f"{path} is not a YAML file of OpenCV's, which begins with %YAML: restore the file")
        with parsing(f"{path}, which is not a YAML file of OpenCV's"):
            self._storage = cv2.FileStorage(text, flags)  # the nodes live as long as their storage
        if not self._storage.isOpened():
            raise D2Error(f"{path} is not a YAML file of OpenCV's: restore the file")

    def names(self) -> list[str]:
        """The list `names`, empty where there is none."""
        with parsing(f"names in {self.path}"):
            node = self._storage.getNode("names")
            return [_text(node.at(i)) for i in range(node.size())] if node.isSeq() else []

    def matrix(self, *keys: str) -> np.ndarray | None:
        """The matrix under the first of `keys` that is there, float64, or None."""
        for key in keys:
            with parsing(f"{key} in {self.path}"):
                node = self._storage.getNode(key)
                if node.empty():
                    continue
                matrix = self._small_matrix(node)
            if matrix is None:
                raise D2Error(f"{key} in {self.path} is no matrix of numbers: write it as !!opencv-matrix")
            if not np.isfinite(matrix).all() or np.abs(matrix).max(initial=0) > LARGEST_NUMBER:
                raise D2Error(f"{key} in {self.path} has a number that is not finite or too large: correct it")
            return matrix
        return None

    @staticmethod
    def _small_matrix(node: Any) -> np.ndarray | None:
        """The numbers of a matrix node, or None: a size is looked at before OpenCV takes memory for it."""
        if not node.isMap():
            return None
        sizes = node.getNode("sizes")  # of matrices with one axis, or more than two
        many = [sizes.at(i) for i in range(min(sizes.size(), 3))] if sizes.isSeq() else []
        sides = many or [node.getNode(name) for name in ("rows", "cols")]
        if len(sides) > 2 or not all(side.isInt() and 0 < side.real() <= LARGEST_MATRIX for side in sides):
            return None
        matrix = node.mat()
        return None if matrix is None else np.asarray(matrix, np.float64)

    def number(self, key: str) -> float | None:
        """The number under `key`, or None."""
        with parsing(f"{key} in {self.path}"):
            node = self._storage.getNode(key)
            number = float(node.real()) if node.isReal() or node.isInt() else None
        if number is not None and not abs(number) <= LARGEST_NUMBER:
            raise D2Error(f"{key} in {self.path} is {number:g}: correct the calibration")
        return number


def recognised(document: Document) -> bool:
    """A folder with both files, or one of the two beside the other."""
    return _folder(document.path) is not None


def read(document: Document) -> list[Entry]:
    """The cameras that both files describe, in the order of extri.yml.

    The published files give the intrinsics of more cameras than they give poses of: those are left out.
    """
    folder = _folder(document.path) or document.path
    intrinsics, extrinsics = OpencvYaml(folder / INTRINSICS), OpencvYaml(folder / EXTRINSICS)
    names = dict.fromkeys([*extrinsics.names(), *intrinsics.names()])
    both = [
        name
        for name in names
        if intrinsics.matrix(f"K_{name}") is not None and extrinsics.matrix(f"T_{name}") is not None
    ]
    if not both:
        raise D2Error(
            f"{folder} has no camera with K_ in {INTRINSICS} and T_ in {EXTRINSICS}: give both the list `names`"
        )
    return [entry_of(name, intrinsics, extrinsics) for name in both]


def entry_of(name: str, intrinsics: OpencvYaml, extrinsics: OpencvYaml) -> Entry:
    """One camera of the two files."""
    where = str(intrinsics.path)
    K = _shaped(intrinsics.matrix(f"K_{name}"), (3, 3), f"K_{name}", where)
    K[:2, 2] += OPENCV_CENTRE
    width, height = intrinsics.number(f"W_{name}"), intrinsics.number(f"H_{name}")
    size = (round(width), round(height)) if width and height else None
    distortion = intrinsics.matrix(f"D_{name}", f"dist_{name}")
    coefficients = () if distortion is None else tuple(np.ravel(distortion).tolist())
    return Entry(name, size, K, "opencv", coefficients, _pose(name, extrinsics))


def _folder(path: Path) -> Path | None:
    folder = path if path.is_dir() else path.parent
    named = path.is_dir() or path.name in (INTRINSICS, EXTRINSICS)
    return folder if named and all((folder / name).is_file() for name in (INTRINSICS, EXTRINSICS)) else None


def _pose(name: str, extrinsics: OpencvYaml) -> np.ndarray:
    """T_camera_world [4, 4]; the rotation vector is preferred, as the layout's own readers do."""
    where = str(extrinsics.path)
    translation = _shaped(extrinsics.matrix(f"T_{name}"), (3,), f"T_{name}", where)
    vector = extrinsics.matrix(f"R_{name}")
    if vector is not None:
        return rigid(rotation_of_vector(_shaped(vector, (3,), f"R_{name}", where)), translation)
    rotation = extrinsics.matrix(f"Rot_{name}")
    if rotation is None:
        raise D2Error(f"{where} has neither R_{name} nor Rot_{name}: add the rotation of camera {name}")
    return rigid(_shaped(rotation, (3, 3), f"Rot_{name}", where), translation)


def _shaped(matrix: np.ndarray | None, shape: tuple[int, ...], key: str, where: str) -> np.ndarray:
    if matrix is None or matrix.size != np.prod(shape):
        found = "nothing" if matrix is None else f"shape {matrix.shape}"
        raise D2Error(f"{key} in {where} has {found}, expected {shape}: correct the calibration")
    return matrix.reshape(shape)


def _text(node: Any) -> str:
    """A name as text: YAML reads a name without quotes as a number."""
    return node.string() if node.isString() else str(int(node.real()))

"""ENeRF-Outdoor and other captures of EasyMocap and EasyVolcap: intri.yml and extri.yml beside images/<camera>/.

Both are OpenCV's YAML. intri.yml: K_<camera> and D_<camera> or dist_<camera>; extri.yml: R_<camera> (rotation vector)
or Rot_<camera> (matrix) and T_<camera>, mapping world to camera. Principal points are taken as they are written.
Pictures are undistorted on load with K kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.captures.assembly import assembled
from d2_plugin.captures.calibration import LARGEST_NUMBER, checked_camera, resized, rigid
from d2_plugin.captures.capture import Camera, Capture
from d2_plugin.captures.files import FrameFiles, common_frames, numbered_files
from d2_plugin.captures.lens import Lens, opencv_lens
from d2_plugin.captures.pictures import opencv, picture_size
from d2_plugin.captures.rotations import rotation_of_vector
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import parsing, read_text

LARGEST_MATRIX = 64
"""Rows and columns of a calibration's matrices, at most."""

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"

ENERF_FPS = 60.0
"""Frame rate at which EasyVolcap plays the data set; the files name none."""

NOT_USED = ("masks", "mask", "bgmtv2", "bkgd", "vhull", "background.ply")
"""What recordings of this layout may also hold. It is not used, because the whole picture is the truth."""


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


def is_enerf(path: Path) -> bool:
    """Whether `path` looks like the layout of EasyMocap and EasyVolcap."""
    return (path / INTRINSICS).is_file()


def open_enerf(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Capture:
    """Read the layout of EasyMocap and EasyVolcap; of the pictures only headers are opened.

    The published files name cameras of which only some have a pose or pictures: the others are left out with a note,
    whatever `intersect` says. A camera that is asked for by name must have all three.
    """
    intrinsics, extrinsics = OpencvYaml(path / INTRINSICS), OpencvYaml(path / EXTRINSICS)
    folders = {folder.name: folder for folder in sorted((path / "images").glob("*")) if folder.is_dir()}
    names, notes = _agreed(intrinsics, extrinsics, list(folders), cameras, path)
    images = {name: numbered_files(folders[name]) for name in names}
    frames, frame_notes = common_frames(images, path / "images")
    calibrated = {name: _camera(name, intrinsics, extrinsics, images[name], frames[0]) for name in names}
    unused = [name for name in NOT_USED if (path / name).exists()]
    return assembled(
        path,
        {name: camera for name, (camera, _) in calibrated.items()},
        images,
        frames,
        ENERF_FPS,
        (*notes, *frame_notes, *((f"not used: {', '.join(unused)}",) if unused else ())),
        {name: lens for name, (_, lens) in calibrated.items()},
    )


def _agreed(
    intrinsics: OpencvYaml, extrinsics: OpencvYaml, folders: list[str], asked: tuple[str, ...] | None, path: Path
) -> tuple[list[str], tuple[str, ...]]:
    """(cameras with intrinsics, pose and pictures, notes)."""
    listed = list(dict.fromkeys([*extrinsics.names(), *intrinsics.names(), *folders]))
    lacks = {
        name: [
            *([INTRINSICS] if intrinsics.matrix(f"K_{name}") is None else []),
            *([EXTRINSICS] if extrinsics.matrix(f"T_{name}") is None else []),
            *(["images"] if name not in folders else []),
        ]
        for name in listed
    }
    complete = sorted(name for name in listed if not lacks[name])
    for name in asked or ():
        if name not in lacks:
            raise unknown_name("camera", name, complete)
        if lacks[name]:
            raise D2Error(
                f"camera {name} of {path} is missing in {' and '.join(lacks[name])}: choose among {', '.join(complete)}"
            )
    if not complete:
        raise D2Error(
            f"no camera of {path} has intrinsics in {INTRINSICS}, a pose in {EXTRINSICS} and a folder in images: "
            "name the folders as the files name the cameras"
        )
    missing = [f"{name} (no {', '.join(lacks[name])})" for name in listed if lacks[name]]
    notes = (f"left out, calibration or pictures missing: {', '.join(missing)}",) if missing and asked is None else ()
    return list(asked) if asked is not None else complete, notes


def _camera(
    name: str, intrinsics: OpencvYaml, extrinsics: OpencvYaml, files: FrameFiles, frame: int
) -> tuple[Camera, Lens]:
    """The pinhole camera of the undistorted pictures, and the lens of the recorded ones."""
    size, where = picture_size(files[frame]), str(intrinsics.path)
    K = _shaped(intrinsics.matrix(f"K_{name}"), (3, 3), f"K_{name}", where)
    width, height = intrinsics.number(f"W_{name}"), intrinsics.number(f"H_{name}")
    if width and height:
        K = resized(K, (round(width), round(height)), size, name, where)
    distortion = intrinsics.matrix(f"D_{name}", f"dist_{name}")
    lens = opencv_lens(K, np.zeros(5) if distortion is None else distortion, f"camera {name} in {where}")
    near, far = extrinsics.number(f"n_{name}"), extrinsics.number(f"f_{name}")
    near_far = (near, far) if near is not None and far is not None else None
    pose = _pose(name, extrinsics)
    return checked_camera(name, size, lens.pinhole, pose, near_far, f"{where} and {EXTRINSICS}"), lens


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

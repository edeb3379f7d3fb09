"""COLMAP's sparse models, binary and text, and its rig_config.json; no COLMAP is needed to read them.

Axes are OpenCV's, poses map world to camera, quaternions have w first, and pixel centres lie at i + 0.5, all as in the
rest of the plugin. A model's rigs.bin and frames.bin are not needed: images carry the poses that follow from them. Its
scale is arbitrary. rig_config.json has the pose of each camera of a rig, whose axes are the world's here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import LONGEST_NAME, D2Error
from d2_plugin.reading import field, parsing, read_bytes, read_text
from d2_plugin.recordings.cameras.camera import LARGEST_NUMBER, CalibratedCamera, pinhole, rigid
from d2_plugin.recordings.cameras.formats.document import CORRECT, Document, coefficients, has, numbers, object_of
from d2_plugin.recordings.cameras.lens import Lens, checked_lens
from d2_plugin.recordings.cameras.rotations import rotation_of_quaternion
from d2_plugin.recordings.files import Reading, Shot, arrange

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)),
)
"""Camera models in the order of their number in binary files, with their number of parameters."""

LENSES = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE"), "pinhole"),
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"), "opencv"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
}
"""Models that can be undone -> the lens whose coefficients, in this order, follow the principal point."""

TWO_FOCAL_LENGTHS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")

SAME_POSE = 0.02
"""Poses of one standing camera may differ by this much (radians, and share of the scene's camera spread): bundle
adjustment moves every image by itself."""

NO_LENS = "add camera_model_name and camera_params, or give the model that COLMAP made with the rig"


class ColmapCamera(NamedTuple):
    """Intrinsics: the model's name, size in pixels, and its parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    def lens(self, where: str) -> Lens:
        """Focal lengths, principal point and distortion; `D2Error` for a model without undistortion here."""
        p = self.parameters if self.model in TWO_FOCAL_LENGTHS else (*self.parameters[:1], *self.parameters)
        if self.model not in LENSES or len(self.parameters) != dict(MODELS)[self.model]:
            raise D2Error(
                f"{where} has a camera of model {self.model[:LONGEST_NAME]} with {len(self.parameters)} parameters, "
                "which cannot be undistorted here: run `colmap image_undistorter` and give its output folder"
            )
        return checked_lens(pinhole(*p[:4]), LENSES[self.model], p[4:], where)


class ColmapImage(NamedTuple):
    """A registered image: its name relative to the image folder, its camera and its pose."""

    name: str
    camera: int
    T_camera_world: np.ndarray  # [4, 4]

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stood, [3]."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]


class ColmapPoints(NamedTuple):
    """The sparse points."""

    positions: np.ndarray  # [P, 3] float64, world
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] float64, mean reprojection error in pixels


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by id and registered images by id of the model in `folder`."""

    folder: Path
    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]

    def calibrated(self, name: str, image: ColmapImage) -> CalibratedCamera:
        """The camera that took a registered image, under a name of its own."""
        camera = self.cameras[image.camera]
        lens = camera.lens(f"camera {name} in {self.folder}")
        return CalibratedCamera(name, camera.width, camera.height, lens, image.T_camera_world)


def read_colmap(document: Document) -> list[CalibratedCamera] | None:
    """A folder with a model: the cameras that stand still, by name; several images of one camera are one."""
    folder = find_model(document.path) if document.path.is_dir() else None
    if folder is None:
        return None
    model = read_model(folder)
    return [model.calibrated(name, image) for name, image in standing_cameras(model)[0].items()]


def read_rig_config(document: Document) -> list[CalibratedCamera] | None:
    """rig_config.json: a list of one rig, whose cameras have an `image_prefix`; it names no sizes of images."""
    rigs = document.content
    if not has(rigs, "cameras") or not has(rigs[0]["cameras"], "image_prefix"):
        return None
    if len(rigs) != 1:
        raise D2Error(f"{document.place} has {len(rigs)} rigs, expected one: split the file")
    return [_rig_camera(entry, document.place) for entry in rigs[0]["cameras"]]


def _rig_camera(entry: Any, document: str) -> CalibratedCamera:
    table = object_of(entry, f"a camera in {document}")
    name = field(table, "image_prefix", str, f"a camera in {document}", CORRECT).strip("/").rpartition("/")[2]
    place = f"camera {name} in {document}"
    model = field(table, "camera_model_name", str, place, NO_LENS)
    parameters = tuple(coefficients(table, "camera_params", place).tolist())
    if not parameters or model not in dict(MODELS):
        raise D2Error(f"{place} has the model {model} and no parameters that go with it: {NO_LENS}")
    pose = np.eye(4)
    if not field(table, "ref_sensor", bool, place, CORRECT, default=False):
        quaternion = numbers(table, "cam_from_rig_rotation", (4,), place)
        with parsing(f"the rotation of {place}", CORRECT):
            pose = rigid(rotation_of_quaternion(quaternion), numbers(table, "cam_from_rig_translation", (3,), place))
    return CalibratedCamera(name, 0, 0, ColmapCamera(model, 0, 0, parameters).lens(place), pose)


def standing_cameras(model: ColmapModel) -> tuple[dict[str, ColmapImage], dict[str, Shot], Reading | None]:
    """One registered image per camera, camera and frame of all of them, and how their names were read.

    Images CAMERA/FRAME.png of one pose are one camera.
    """
    registered = {image.name: image for image in model.images.values()}
    centres = np.stack([image.centre for image in registered.values()])
    reach = SAME_POSE * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()) + 1e-9

    def still(names: list[str]) -> bool:
        first, *others = (registered[name] for name in names)
        return all(
            _angle(first, one) <= SAME_POSE and np.linalg.norm(one.centre - first.centre) <= reach for one in others
        )

    shots, reading = arrange(registered, still)
    poses: dict[str, ColmapImage] = {}
    for name in sorted(shots, key=lambda name: shots[name].frame):
        poses.setdefault(shots[name].camera, registered[name])
    return dict(sorted(poses.items())), shots, reading


def _angle(one: ColmapImage, other: ColmapImage) -> float:
    """By how much two images are turned against each other, radians."""
    turn = one.T_camera_world[:3, :3] @ other.T_camera_world[:3, :3].T
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def find_model(path: Path) -> Path | None:
    """Where under a recording's folder its sparse model lies, or None."""
    for place in ("sparse/0", "sparse", "colmap/sparse/0", "distorted/sparse/0", "."):
        folder = path / place
        if any(all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")) for suffix in _SUFFIXES):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Cameras and images of the model in `folder`; binary files are preferred, as COLMAP does."""
    cameras_file, images_file = _file(folder, "cameras"), _file(folder, "images")
    cameras = _by_number(cameras_file, _parse(cameras_file, _binary_cameras, _text_cameras))
    images = _by_number(images_file, _parse(images_file, _binary_images, _text_images))
    if not images:
        raise D2Error(f"{images_file} registers no image: run COLMAP's mapper or point triangulator again")
    for image in images.values():
        if image.camera not in cameras:
            raise D2Error(f"{image.name} in {images_file} uses camera {image.camera}, which {cameras_file} lacks")
    return ColmapModel(folder, cameras, images)


def read_points(folder: Path) -> ColmapPoints:
    """The sparse points of the model in `folder`, in the order of the file; none where it has no such file."""
    there = any((folder / f"points3D{suffix}").is_file() for suffix in _SUFFIXES)
    rows = list(_parse(_file(folder, "points3D"), _binary_points, _text_points)) if there else []
    table = np.array(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(table).all() or np.abs(table).max(initial=0) > LARGEST_NUMBER:
        raise D2Error(f"{folder} has points with numbers that are not finite or too large: export the model again")
    table[:, 3:6] = table[:, 3:6].clip(0, 255)
    return ColmapPoints(table[:, :3], table[:, 3:6].astype(np.uint8), table[:, 6])


def _by_number(path: Path, pairs: Iterable[tuple[int, Any]]) -> dict[int, Any]:
    entries: dict[int, Any] = {}
    for number, entry in pairs:
        if number in entries:
            raise D2Error(f"{path} has two entries with number {number}: export the model again")
        entries[number] = entry
    return entries


_SUFFIXES = (".bin", ".txt")


def _file(folder: Path, part: str) -> Path:
    for suffix in _SUFFIXES:
        if (folder / f"{part}{suffix}").is_file():
            return folder / f"{part}{suffix}"
    raise D2Error(f"{folder} has no {part}.bin and no {part}.txt: give the folder of a COLMAP model")


def _parse(path: Path, binary: Any, text: Any) -> Iterator[Any]:
    with parsing(f"{path} as a COLMAP model", "export the model again"):
        if path.suffix == ".bin":
            yield from binary(_Cursor(read_bytes(path, "export the model again")))
        else:
            yield from text(read_text(path, "export the model again").splitlines())


class _Cursor:
    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self.data, self.place)
        self.place += struct.calcsize("<" + layout)
        return values

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise ValueError("it ends in the middle of a record")

    def name(self) -> str:
        end = self.data.index(b"\0", self.place)
        text = self.data[self.place : end].decode()
        self.place = end + 1
        return text


def _binary_cameras(cursor: _Cursor) -> Iterator[tuple[int, ColmapCamera]]:
    for _ in range(*cursor.take("Q")):
        identity, model, width, height = cursor.take("iiQQ")
        if not 0 <= model < len(MODELS):
            raise ValueError(f"camera model number {model} is not among 0 to {len(MODELS) - 1}")
        name, count = MODELS[model]
        yield identity, ColmapCamera(name, width, height, cursor.take(f"{count}d"))


def _binary_images(cursor: _Cursor) -> Iterator[tuple[int, ColmapImage]]:
    for _ in range(*cursor.take("Q")):
        identity, *pose, camera = cursor.take("I7dI")
        name = cursor.name()
        (observations,) = cursor.take("Q")
        cursor.skip(24 * observations)
        yield identity, ColmapImage(name, camera, _transform(pose))


def _binary_points(cursor: _Cursor) -> Iterator[tuple[float, ...]]:
    for _ in range(*cursor.take("Q")):
        _, *values, error, track = cursor.take("Q3d3BdQ")
        cursor.skip(8 * track)
        yield *values, error


def _text_cameras(lines: list[str]) -> Iterator[tuple[int, ColmapCamera]]:
    for line in _content(lines):
        identity, model, width, height, *parameters = line.split()
        yield int(identity), ColmapCamera(model, int(width), int(height), tuple(map(float, parameters)))


def _text_images(lines: list[str]) -> Iterator[tuple[int, ColmapImage]]:
    # Each image has two lines and the second one, its observations, may be empty.
    rows = iter([line for line in lines if not line.startswith("#")])
    for line in rows:
        if line.strip():
            identity, *pose, camera, name = line.strip().split(" ", 9)
            yield int(identity), ColmapImage(name, int(camera), _transform([float(value) for value in pose]))
            next(rows, None)


def _text_points(lines: list[str]) -> Iterator[tuple[float, ...]]:
    for line in _content(lines):
        numbers = tuple(float(value) for value in line.split()[1:8])
        if len(numbers) < 7:
            raise ValueError(f"a point has {len(numbers)} numbers behind its own, expected at least 7")
        yield numbers


def _content(lines: list[str]) -> Iterator[str]:
    return (line for line in lines if line.strip() and not line.startswith("#"))


def _transform(pose: list[float]) -> np.ndarray:
    """T [4, 4] of qw qx qy qz tx ty tz."""
    if not all(abs(number) <= LARGEST_NUMBER for number in pose[4:7]):
        raise ValueError(f"an image stands at {pose[4]:g} {pose[5]:g} {pose[6]:g}")
    return rigid(rotation_of_quaternion(np.array(pose[:4])), np.array(pose[4:7]))

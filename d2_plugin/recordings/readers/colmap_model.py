"""COLMAP's sparse models, binary and text, as plain data; no COLMAP is needed to read them.

Axes are OpenCV's, poses map world to camera, quaternions have w first, and pixel centres lie at i + 0.5, all as in the
rest of the plugin.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import LONGEST_NAME, D2Error
from d2_plugin.reading import read_bytes, read_text, said
from d2_plugin.recordings.cameras.calibration import LARGEST_NUMBER, pinhole, rigid
from d2_plugin.recordings.cameras.lens import Lens, opencv_lens
from d2_plugin.recordings.cameras.rotations import rotation_of_quaternion

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)),
)
"""Camera models in the order of their number in binary files, with their number of parameters."""


class ColmapCamera(NamedTuple):
    """Intrinsics: the model's name, size in pixels, and its parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    def lens(self, where: str) -> Lens:
        """Focal lengths, principal point and distortion; `D2Error` for a model without undistortion here."""
        p = self.parameters
        kind = (self.model, len(p))
        if kind == ("SIMPLE_PINHOLE", 3):
            return Lens(pinhole(p[0], p[0], p[1], p[2]))
        if kind == ("PINHOLE", 4):
            return Lens(pinhole(*p))
        if kind in (("SIMPLE_RADIAL", 4), ("RADIAL", 5)):
            return Lens(pinhole(p[0], p[0], p[1], p[2]), p[3:])
        if kind == ("OPENCV", 8):
            return Lens(pinhole(*p[:4]), p[4:6], (p[6], p[7]))
        if kind == ("FULL_OPENCV", 12):
            return opencv_lens(pinhole(*p[:4]), np.array(p[4:]), where)
        if kind == ("OPENCV_FISHEYE", 8):
            return Lens(pinhole(*p[:4]), p[4:], fisheye=True)
        if kind in (("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)):
            return Lens(pinhole(p[0], p[0], p[1], p[2]), p[3:], fisheye=True)
        raise D2Error(
            f"{where} has a camera of model {self.model[:LONGEST_NAME]} with {len(p)} parameters, which cannot be "
            "undistorted here: run `colmap image_undistorter` and give its output folder"
        )


class ColmapImage(NamedTuple):
    """A registered image: its name relative to the image folder, its camera and its pose."""

    name: str
    camera: int
    T_camera_world: np.ndarray  # [4, 4]


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
    if not any((folder / f"points3D{suffix}").is_file() for suffix in _SUFFIXES):
        rows = []
    else:
        rows = list(_parse(_file(folder, "points3D"), _binary_points, _text_points))
    table = np.array(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(table).all() or np.abs(table).max(initial=0) > LARGEST_NUMBER:
        raise D2Error(f"{folder} has points with numbers that are not finite or too large: export the model again")
    table[:, 3:6] = table[:, 3:6].clip(0, 255)
    return ColmapPoints(table[:, :3], table[:, 3:6].astype(np.uint8), table[:, 6])


def _by_number(path: Path, pairs: Iterable[tuple[int, Any]]) -> dict[int, Any]:
    """Entries by their number, which no two share."""
    found: dict[int, Any] = {}
    for number, entry in pairs:
        if number in found:
            raise D2Error(f"{path} has two entries with number {number}: export the model again")
        found[number] = entry
    return found


_SUFFIXES = (".bin", ".txt")


def _file(folder: Path, part: str) -> Path:
    for suffix in _SUFFIXES:
        if (folder / f"{part}{suffix}").is_file():
            return folder / f"{part}{suffix}"
    raise D2Error(f"{folder} has no {part}.bin and no {part}.txt: give the folder of a COLMAP model")


def _parse(path: Path, binary: Any, text: Any) -> Iterator[Any]:
    try:
        if path.suffix == ".bin":
            yield from binary(_Cursor(read_bytes(path, "export the model again")))
        else:
            yield from text(read_text(path, "export the model again").splitlines())
    except D2Error:
        raise
    except (struct.error, ValueError, IndexError, OverflowError) as failure:
        raise D2Error(f"{path} is damaged or no COLMAP model ({said(failure)}): export the model again") from None


class _Cursor:
    """Reads little-endian numbers one after the other."""

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

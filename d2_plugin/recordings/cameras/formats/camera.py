"""One camera as a calibration file describes it, lens and all, in this project's conventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.recordings.cameras.calibration import LARGEST_NUMBER, checked_camera, resized, rigid
from d2_plugin.recordings.cameras.lens import LARGEST_COEFFICIENT, Lens, opencv_lens
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments, shown

Model = Literal["pinhole", "opencv", "fisheye"]

MODELS: tuple[str, ...] = get_args(Model)
"""No distortion; OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 (trailing zeros may be left out); OpenCV's fisheye k1 k2 k3 k4."""

OPENCV_CENTRE = 0.5
"""What is added to principal points of formats whose first pixel has its centre at 0, as OpenCV's has."""


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A camera as its images were recorded: nothing is undistorted yet.

    Axes are OpenCV's and x_cam = R X + t. `matrix` is in pixels of an image of `width` x `height`, whose pixel i has
    its centre at i + 0.5. The distortion acts on rays at z = 1, see `d2_plugin.recordings.cameras.lens`.
    """

    name: str
    width: int
    height: int
    matrix: np.ndarray  # [3, 3] float64, pixels
    model: str  # one of MODELS
    distortion: tuple[float, ...]
    rotation: np.ndarray  # [3, 3] float64, world to camera
    translation: np.ndarray  # [3] float64, in the unit of the file

    @property
    def T_camera_world(self) -> np.ndarray:
        """World to camera, [4, 4]."""
        return rigid(self.rotation, self.translation)

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands in the world, [3]."""
        return -self.rotation.T @ self.translation

    @property
    def lens(self) -> Lens:
        """How the camera recorded, to undo it or to distort pixels: `camera.lens.recorded_pixels(pixels)`."""
        where = f"the calibration of camera {self.name}"
        values = np.array(self.distortion, np.float64)
        if not np.isfinite(values).all() or np.abs(values).max(initial=0) > LARGEST_COEFFICIENT:
            raise D2Error(
                f"{where} has distortion coefficients {shown(list(self.distortion))}, expected numbers of at most "
                f"{LARGEST_COEFFICIENT:g} in size: correct the calibration"
            )
        if self.model == "fisheye":
            if len(values) > 4:
                raise D2Error(f"{where} has {len(values)} fisheye coefficients, expected k1 k2 k3 k4: correct it")
            return Lens(self.matrix, tuple(map(float, values)), fisheye=True)
        if self.model == "opencv":
            return opencv_lens(self.matrix, values, where)
        if self.model == "pinhole":
            return Lens(self.matrix)
        raise unknown_name("camera model", self.model, MODELS)

    def pinhole(self, where: str = "the calibration", near_far: tuple[float, float] | None = None) -> Camera:
        """The pinhole camera of the undistorted images: the same size, focal lengths and principal point.

        Raises:
            D2Error: a number that no camera has, a mirrored pose or an R that is no rotation; `where` names the file.
        """
        return checked_camera(
            self.name, (self.width, self.height), self.lens.pinhole, self.T_camera_world, near_far, where
        )

    def of_size(self, size: tuple[int, int], where: str = "the calibration") -> CalibratedCamera:
        """The same camera for recordings that are scaled to `size` (width, height); another aspect is refused."""
        if (self.width, self.height) == size:
            return self
        matrix = resized(self.matrix, (self.width, self.height), size, self.name, where)
        return replace(self, width=size[0], height=size[1], matrix=matrix)


class Entry(NamedTuple):
    """One camera as a file has it, not checked yet; `size` is None where the file names no size of images."""

    name: str
    size: tuple[int, int] | None  # (width, height)
    matrix: np.ndarray
    model: str
    distortion: tuple[float, ...]
    T_camera_world: np.ndarray  # [4, 4]

    def recorded(self, size: tuple[int, int] | None, where: str) -> CalibratedCamera:
        """The camera of recordings of `size`, or of the size that the file names where that is None."""
        calibrated = self.size or size
        if calibrated is None:
            raise D2Error(f"{where} names no size of the images of camera {self.name}: give the recordings with it")
        T = self.T_camera_world
        camera = CalibratedCamera(self.name, *calibrated, self.matrix, self.model, self.distortion, T[:3, :3], T[:3, 3])
        return camera if size is None else camera.of_size(size, where)


@checked_arguments
def scaled(cameras: Sequence[CalibratedCamera], scale: float) -> tuple[CalibratedCamera, ...]:
    """The cameras in a world whose unit is 1 / `scale` of the old one: .001 makes metres of millimetres."""
    if not 0 < scale < LARGEST_NUMBER:
        raise D2Error(f"scale is {scale:g}, expected a number above 0, such as .001 for millimetres")
    return tuple(replace(camera, translation=camera.translation * scale) for camera in cameras)


def of_lens(lens: Lens) -> tuple[str, tuple[float, ...]]:
    """(model, distortion) of a lens, in the order of `MODELS`."""
    if lens.fisheye:
        return "fisheye", lens.radial
    if not any(lens.radial) and not any(lens.tangential):
        return "pinhole", ()
    k = (*lens.radial, 0.0, 0.0, 0.0)
    return "opencv", (k[0], k[1], *lens.tangential, k[2], *lens.denominator)

"""Cameras of calibration files, checked before they become a `Camera`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments, shown

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z backward) to OpenCV's (y down, z forward), and back."""

ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I that still counts as rounding in a text file

ASPECT_TOLERANCE = 0.01
"""Relative difference of horizontal and vertical scale that still counts as rounding of a size to whole pixels."""

LARGEST_NUMBER = 1e9
"""Larger positions, depths and pixels are refused: float32, which everything is computed in, has 7 digits."""

OPENCV_CENTRE = 0.5
"""What is added to principal points of formats whose first pixel has its centre at 0, as OpenCV's has."""

LARGEST_SIDE = 65_535  # most pixels along a side, as JPEG has it

FIELD_OF_VIEW = (0.5, 178.0)
"""A camera that sees less or more than this, in degrees, is refused. What is unusual is noted, see `check`."""

MOST_OBLIQUE = 80.0
"""Degrees between a camera's axis and the middle of its image, at most: what is farther out is no principal point."""

FOCAL_RATIO = 4.0  # fx and fy differ by less than this factor: anamorphic lenses reach 2
FRAME_RATES = (1e-6, 1e6)  # frames per second: from one in eleven days to a million
LONGEST_NAME = 100  # letters of a camera's name, which becomes a folder and part of file names


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A camera as its images were recorded: nothing is undistorted yet.

    Axes are OpenCV's and x_cam = R X + t; `lens.K` is in pixels whose centres lie at i + 0.5.
    """

    name: str
    width: int
    height: int  # pixels of the images; both 0 where a file names no size
    lens: Lens
    T_camera_world: np.ndarray  # [4, 4] float64, world to camera, in the unit of the file
    near_far: tuple[float, float] | None = None  # depth range that the file declares, world units

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands in the world, [3]."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    def pinhole(self, where: str = "the calibration") -> Camera:
        """The pinhole camera of the undistorted images: the same size, focal lengths and principal point.

        Raises:
            D2Error: a number that no camera has, or an R that is no rotation; `where` names the file.
        """
        return checked_camera(self.name, self.size, self.lens.pinhole, self.T_camera_world, self.near_far, where)

    def of_size(self, size: tuple[int, int], where: str = "the calibration") -> CalibratedCamera:
        """The same camera for images that are scaled to `size` (width, height); another aspect is refused."""
        K = resized(self.lens.K, self.size if self.width else size, size, self.name, where)
        return replace(self, width=size[0], height=size[1], lens=replace(self.lens, K=K))


@checked_arguments
def scaled(cameras: Sequence[CalibratedCamera], scale: float) -> tuple[CalibratedCamera, ...]:
    """The cameras in a world whose unit is 1 / `scale` of the old one: .001 makes metres of millimetres."""
    if not 0 < scale < LARGEST_NUMBER:
        raise D2Error(f"scale is {scale:g}, expected a number above 0, such as .001 for millimetres")
    return tuple(
        replace(
            one,
            T_camera_world=rigid(one.T_camera_world[:3, :3], scale * one.T_camera_world[:3, 3]),
            near_far=one.near_far and (scale * one.near_far[0], scale * one.near_far[1]),
        )
        for one in cameras
    )


def rig_width(cameras: Iterable[Camera | CalibratedCamera]) -> float:
    """Largest distance between two cameras."""
    centres = np.stack([camera.centre for camera in cameras])
    return float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())


def same_spot(first: Camera | CalibratedCamera, second: Camera | CalibratedCamera) -> bool:
    """Whether two cameras stand on the same spot, up to rounding: they see no parallax.

    How far R is from a rotation tells to how many digits a pose was written: float32 has seven.
    """
    rotations = np.stack([camera.T_camera_world[:3, :3] for camera in (first, second)])
    skewed = float(np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max())
    baseline = np.linalg.norm(first.centre - second.centre)
    return bool(baseline <= np.clip(8 * skewed, 1e-9, 1e-6) * np.linalg.norm([first.centre, second.centre]))


def focus_of(centres: np.ndarray, forwards: np.ndarray, depth: float | None = None) -> np.ndarray:
    """The point [3] nearest to all optical axes; `depth` before the mean camera where they do not meet in front of all.

    Args:
        centres: of the cameras [N, 3].
        forwards: unit vectors [N, 3] along their axes.
        depth: world units; four times the spread of the centres where none is given.
    """
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # projections across each axis
    normal, right = across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0]
    eigenvalues = np.linalg.eigvalsh(normal)
    if eigenvalues[0] > 1e-4 * len(centres):
        point = np.linalg.solve(normal, right)
        if ((point - centres) * forwards).sum(axis=1).min() > 0:
            return point
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    far = depth if depth is not None else max(4 * spread, 1.0)
    return centres.mean(axis=0) + far * unit(forwards.mean(axis=0))


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K [3, 3] float64 in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """T [4, 4] float64 from R [3, 3] and t [3]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector at length 1."""
    return vector / max(np.linalg.norm(vector), 1e-12)


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """T_camera_world [4, 4] of a camera at `position` that looks at `target`, upright."""
    forward = unit(target - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any side will do
        right = np.cross(forward, np.roll(up, 1))
    right = unit(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return rigid(R, -R @ position)


def resized(K: np.ndarray, calibrated: tuple[int, int], images: tuple[int, int], name: str, where: str) -> np.ndarray:
    """K for images that are smaller or larger copies of the size (width, height) that was calibrated."""
    if not all(1 <= length <= LARGEST_SIDE for length in (*calibrated, *images)):
        raise D2Error(
            f"camera {name} in {where} has the size {shown(calibrated[0])} x {shown(calibrated[1])}, expected 1 to "
            f"{LARGEST_SIDE} pixels: correct the calibration"
        )
    if not (np.abs(K) <= LARGEST_NUMBER).all():
        raise D2Error(
            f"camera {name} in {where} has a K with a number that is not finite or larger than {LARGEST_NUMBER:g}: "
            "correct the calibration"
        )
    scale = np.array(images) / calibrated
    if abs(scale[1] - scale[0]) > ASPECT_TOLERANCE * scale[0]:
        raise D2Error(
            f"images of camera {name} are {images[0]}x{images[1]} but {where} says {calibrated[0]}x"
            f"{calibrated[1]}, another aspect: use images that are scaled, not cropped or turned (EXIF is not followed)"
        )
    return np.diag([*scale, 1.0]) @ K


def checked_camera(
    name: str,
    size: tuple[int, int],
    K: np.ndarray,
    T_camera_world: np.ndarray,
    near_far: tuple[float, float] | None,
    where: str,
) -> Camera:
    """A `Camera` of `size` (width, height), or one sentence that says which number in the file `where` is wrong."""

    def refuse(problem: str) -> D2Error:
        return D2Error(f"camera {name} in {where} {problem}: correct the calibration")

    check_name(name, where)
    if not (np.isfinite(K).all() and np.isfinite(T_camera_world).all()):
        raise refuse("has a number that is not finite")
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise refuse(
            f"has the size {shown(size[0])}x{shown(size[1])}, expected at least one pixel and at most {LARGEST_SIDE} "
            "a side"
        )
    largest = max(np.abs(K[:2]).max(), np.abs(T_camera_world).max())
    if largest > LARGEST_NUMBER:
        raise refuse(f"has the number {largest:g}, expected pixels and positions of at most {LARGEST_NUMBER:g} in size")
    low, high = sorted((K[0, 0], K[1, 1]))
    if low <= 0 or high > FOCAL_RATIO * low:
        raise refuse(f"has focal lengths {K[0, 0]:g} and {K[1, 1]:g}, expected positive pixels, nearly the same")
    across, down = field_of_view(K, size)
    if max(across, down) < FIELD_OF_VIEW[0] or max(across, down) > FIELD_OF_VIEW[1]:
        raise refuse(
            f"sees {across:.3g} x {down:.3g} degrees, expected {FIELD_OF_VIEW[0]:g} to {FIELD_OF_VIEW[1]:g} "
            "(are the focal lengths in pixels of these images?)"
        )
    middle = (np.array(size) / 2 - K[:2, 2]) / K[[0, 1], [0, 1]]
    oblique = float(np.rad2deg(np.arctan(np.hypot(*middle))))
    if oblique > MOST_OBLIQUE:
        raise refuse(
            f"has its principal point at ({K[0, 2]:g}, {K[1, 2]:g}), {oblique:.1f} degrees from the middle of the "
            f"image, expected at most {MOST_OBLIQUE:g}"
        )
    rotation = T_camera_world[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise refuse("has an R that is no rotation (orthonormal rows, determinant +1)")
    if near_far is not None and not (1 / LARGEST_NUMBER < near_far[0] < near_far[1] < LARGEST_NUMBER):
        raise refuse(f"has depth bounds {near_far[0]:g} to {near_far[1]:g}, expected 0 < near < far")
    return Camera(name, size[0], size[1], K, T_camera_world, near_far)


def field_of_view(K: np.ndarray, size: tuple[int, int]) -> tuple[float, float]:
    """What a camera sees across and down, degrees, wherever its principal point lies."""
    edges = np.array([[0.0, 0.0], size])
    angles = np.arctan2(edges - K[:2, 2], K[[0, 1], [0, 1]])
    across, down = np.rad2deg(angles[1] - angles[0])
    return float(across), float(down)


def check_name(name: str, where: str) -> None:
    """Refuse a camera's name that cannot be a folder of a prior or cannot be typed among others."""
    unfit = not name or name != name.strip() or name in (".", "..") or len(name) > LONGEST_NAME
    wrong = [letter for letter in name if letter in "/\\," or not letter.isprintable()]
    if unfit or wrong:
        why = f"holds {shown(wrong[0])}" if wrong else "is empty, a dot, too long, or has a space at an end"
        raise D2Error(
            f"the camera name {shown(name)} in {where} {why}: rename it, since names become folders and are joined by "
            "commas"
        )


def checked_rate(fps: float, where: str) -> float:
    """A frame rate, per second, or the sentence that it is none."""
    if not FRAME_RATES[0] <= fps <= FRAME_RATES[1]:
        raise D2Error(
            f"{where} says fps {fps:g}, expected frames per second above 0, from {FRAME_RATES[0]:g} to "
            f"{FRAME_RATES[1]:g}: correct the rate or the times"
        )
    return float(fps)

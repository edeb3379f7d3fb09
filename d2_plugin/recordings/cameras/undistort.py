"""Distortion undone: from here on every camera is a pinhole.

Size and focal length stay, so nothing is cropped or stretched; what was not recorded is black.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera, Source
from d2_plugin.values import checked_arguments

KEPT_MAPS = 8  # cameras whose resampling map stays in memory (6 bytes per pixel each)
COVERAGE = 200  # places across and down, at most, at which it is measured how much of an image is black
MOST_BLACK = 0.5  # share of an undistorted image that may be without a recorded pixel: more is a wrong coefficient


class Undistortion:
    """What turns the images of one camera into a pinhole's: `image` for each, `valid` once, `camera` for the rest."""

    @checked_arguments
    def __init__(self, camera: CalibratedCamera) -> None:
        self._recorded = camera
        self.camera: Camera = camera.pinhole()
        """The pinhole camera of the undistorted images."""
        if camera.lens.bends:
            refuse_black(camera)

    @cached_property
    def valid(self) -> np.ndarray | None:
        """Which pixels of the undistorted images were recorded, bool [H, W]; None where all were."""
        camera = self._recorded
        if not camera.lens.bends:
            return None
        places = camera.lens.recorded_pixels(_centres(camera.width, camera.height))
        with np.errstate(invalid="ignore"):  # NaN is outside, and so is what lies half beyond the edge
            inside = np.asarray(((places >= 0.5) & (places <= np.array(camera.size) - 0.5)).all(axis=-1))
        return None if inside.all() else inside

    def image(self, recorded: np.ndarray) -> np.ndarray:
        """The undistorted image or mask [H, W] or [H, W, C], of the same type, bilinear.

        Raises:
            D2Error: what has not the size of the camera's images.
        """
        expected = (self.camera.height, self.camera.width)
        if not isinstance(recorded, np.ndarray) or recorded.shape[:2] != expected:
            given = recorded.shape if isinstance(recorded, np.ndarray) else type(recorded).__name__
            raise D2Error(f"an image of camera {self.camera.name} is {given}, expected {expected}: give its images")
        if not self._recorded.lens.bends:
            return recorded
        cv2 = opencv("undoing lens distortion")
        return np.asarray(cv2.remap(recorded, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))

    @cached_property
    def _maps(self) -> tuple[Any, Any]:
        """Where each pixel comes from, as `cv2.remap` wants it; cv2 puts centres on whole numbers."""
        cv2 = opencv("undoing lens distortion")
        places = self._recorded.lens.recorded_pixels(_centres(self.camera.width, self.camera.height))
        inside = np.nan_to_num(places - 0.5, nan=-10.0).astype(np.float32)
        maps: tuple[Any, Any] = cv2.convertMaps(inside, None, cv2.CV_16SC2)
        return maps


@dataclass(frozen=True)
class UndistortedSource(Source):
    """The images of `source` as pinhole cameras would have taken them; maps on disk fit these already."""

    source: Source
    cameras: Mapping[str, CalibratedCamera]  # those whose images are undistorted
    _kept: dict[str, Undistortion] = field(default_factory=dict, repr=False)

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self._undone(camera, self.source.image(camera, frame))

    def depth(self, camera: str, frame: int) -> np.ndarray | None:
        return self.source.depth(camera, frame)

    def mono(self, camera: str, frame: int) -> np.ndarray | None:
        return self.source.mono(camera, frame)

    def mask(self, camera: str, frame: int) -> np.ndarray | None:
        mask = self.source.mask(camera, frame)
        return None if mask is None else self._undone(camera, mask)

    def recorded(self, camera: str) -> np.ndarray | None:
        valid = self.source.recorded(camera)
        if camera not in self.cameras:
            return valid
        here = self._undistortion(camera).valid
        if valid is None:
            return here
        kept = self._undone(camera, valid.astype(np.float32)) > 0.99
        return kept if here is None else kept & here

    def _undone(self, camera: str, image: np.ndarray) -> np.ndarray:
        if camera not in self.cameras:
            return image
        if image.shape[:2] != (self.cameras[camera].height, self.cameras[camera].width):
            return image  # `Recording.image` refuses it in its own words
        return self._undistortion(camera).image(image)

    def _undistortion(self, camera: str) -> Undistortion:
        if camera not in self._kept:
            self._kept[camera] = Undistortion(self.cameras[camera])
            while len(self._kept) > KEPT_MAPS:
                del self._kept[next(iter(self._kept))]
        return self._kept[camera]

    def __reduce__(self) -> tuple[Any, ...]:  # maps are made anew in another process
        return UndistortedSource, (self.source, self.cameras)


def refuse_black(camera: CalibratedCamera) -> float:
    """The share of its undistorted images that a camera did not record.

    Raises:
        D2Error: its lens leaves hardly anything of them.
    """
    columns, rows = (min(side, COVERAGE) for side in camera.size)
    grid = _centres(columns, rows) * (camera.width / columns, camera.height / rows)
    places = camera.lens.recorded_pixels(grid)
    share = 1 - float(((places >= 0) & (places <= (camera.width, camera.height))).all(axis=-1).mean())
    if share > MOST_BLACK:
        raise D2Error(
            f"undoing the lens distortion of camera {camera.name} leaves {1 - share:.0%} of its images, expected at "
            f"least {1 - MOST_BLACK:.0%}: correct its distortion coefficients and their model"
        )
    return share


def _centres(columns: int, rows: int) -> np.ndarray:
    """The centre of every pixel [rows, columns, 2]."""
    return np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1)

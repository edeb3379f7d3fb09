"""Lens distortion undone once, when a recording is imported, instead of at every read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.formats.camera import CalibratedCamera
from d2_plugin.recordings.cameras.lens import Lens, Resampling, recorded_pixels, refuse_black, resampled, resampling
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments


@dataclass(frozen=True, eq=False)
class Undistortion:
    """What turns the images of one camera into a pinhole's: `image` for each, `valid` once, `camera` for the rest.

    Size, focal lengths and principal point stay, so nothing is stretched; what was not recorded is black and not valid.
    """

    camera: Camera
    """The pinhole camera of the undistorted images."""
    valid: np.ndarray | None
    """Which of their pixels were recorded, bool [H, W]; None where all were."""
    _maps: Resampling | None

    @classmethod
    @checked_arguments
    def of(cls, camera: CalibratedCamera) -> Undistortion:
        """That of a calibrated camera; one without distortion and skew leaves its images as they are."""
        lens: Lens = camera.lens
        if not lens.bends:
            return cls(camera.pinhole(), None, None)
        size = (camera.width, camera.height)
        valid = recorded_pixels(lens, size)
        refuse_black(1 - float(valid.mean()), camera.name)
        return cls(camera.pinhole(), None if valid.all() else valid, resampling(lens, size))

    def image(self, recorded: np.ndarray) -> np.ndarray:
        """The undistorted image or mask [H, W] or [H, W, C], of the same type.

        Raises:
            D2Error: what has not the size of the camera's images.
        """
        expected = (self.camera.height, self.camera.width)
        if not isinstance(recorded, np.ndarray) or recorded.shape[:2] != expected:
            found = recorded.shape if isinstance(recorded, np.ndarray) else type(recorded).__name__
            raise D2Error(f"an image of camera {self.camera.name} is {found}, expected {expected}: give its images")
        return recorded if self._maps is None else resampled(recorded, self._maps)

"""Calibration files of other tools, read into cameras with their lenses."""

from d2_plugin.captures.calibrations.camera import MODELS, CalibratedCamera, scaled
from d2_plugin.captures.calibrations.table import FORMATS, Calibration, Format, open_calibration, read_calibration
from d2_plugin.captures.calibrations.undistort import Undistortion

__all__ = [
    "FORMATS",
    "MODELS",
    "CalibratedCamera",
    "Calibration",
    "Format",
    "Undistortion",
    "open_calibration",
    "read_calibration",
    "scaled",
]

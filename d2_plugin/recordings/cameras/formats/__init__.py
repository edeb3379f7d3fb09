"""Calibration files of other tools, read into cameras with their lenses."""

from d2_plugin.recordings.cameras.formats.camera import MODELS, CalibratedCamera, scaled
from d2_plugin.recordings.cameras.formats.table import FORMATS, Calibration, Format, open_calibration, read_calibration
from d2_plugin.recordings.cameras.formats.undistort import Undistortion

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

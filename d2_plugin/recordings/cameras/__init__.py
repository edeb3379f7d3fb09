"""Cameras: models, lenses, calibration files, calibrating and checking them."""

"""Poses from pictures: slightly wrong ones refined, unknown ones found, boards that were filmed.

Everything runs on the CPU, with pycolmap and OpenCV (`calibration` extra), and gives the same result each time.
"""

from d2_plugin.captures.calibrate.refine import RefinedPoses, refine

__all__ = ["RefinedPoses", "refine"]

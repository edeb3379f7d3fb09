"""Poses from images: slightly wrong ones refined, unknown ones found, boards that were filmed.

Everything runs on the CPU, with pycolmap and OpenCV (`calibration` extra), and gives the same result each time.
"""

from d2_plugin.recordings.cameras.calibrating.boards import Board, scaled_by_board
from d2_plugin.recordings.cameras.calibrating.refine import RefinedPoses, refine
from d2_plugin.recordings.cameras.calibrating.rig import SolvedRig
from d2_plugin.recordings.cameras.calibrating.solve import solve_rig

__all__ = ["Board", "RefinedPoses", "SolvedRig", "refine", "scaled_by_board", "solve_rig"]

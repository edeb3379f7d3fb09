"""A board that several cameras saw at the same moment: matches that no descriptor is needed for, and the scale.

Boards are ChArUco or plain checkerboards, found by OpenCV. Images are undistorted.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Annotated, Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.bundle import Tracks, fitting, triangulate
from d2_plugin.recordings.cameras.calibrating.features import Features, Matches
from d2_plugin.recordings.cameras.calibrating.rig import SolvedRig
from d2_plugin.recordings.images import checked_image, opencv
from d2_plugin.settings import Range, Settings
from d2_plugin.values import checked_arguments

FEWEST_SIDES = 4  # sides of squares that must be measured

LARGEST_SPREAD = 0.05
"""Interquartile range of the measured sides, as a share of their median, beyond which they say no scale."""

CORNER_ERROR = 4.0  # reprojection error beyond which a corner is left out, in `pixel_error`

Corners = dict[int, np.ndarray]  # number of an inner corner, row by row -> its pixel [2], centres at i + 0.5
Squares = Annotated[int, Range(3, 1000)]  # how many squares a board has along a side


@dataclass(frozen=True)
class Board(Settings):
    """A board of `columns` x `rows` squares with sides of `square`, in the unit that the world gets.

    With `marker`, the side of its ArUco markers, it is a ChArUco board with markers of `dictionary`; without, a plain
    checkerboard. White and black may be exchanged.
    """

    columns: Squares
    rows: Squares
    square: Annotated[float, Range(1e-6, 1e6)]
    marker: Annotated[float, Range(1e-6, 1e6)] | None = None
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.marker is not None and self.marker >= self.square:
            raise D2Error(
                f"the board's markers have sides of {self.marker:g} and its squares of {self.square:g}, expected "
                "smaller markers: give both in the same unit"
            )

    def corners(self, image: np.ndarray) -> Corners:
        """The inner corners in an image, none where it is not seen."""
        cv2 = opencv("finding boards", "calibration")
        grey = cv2.cvtColor(checked_image(image, "the image of a board"), cv2.COLOR_RGB2GRAY)
        if self.marker is not None:
            return self._charuco(cv2, grey)
        whole, corners = cv2.findChessboardCornersSB(grey, (self.columns - 1, self.rows - 1))
        return {i: corner + 0.5 for i, corner in enumerate(corners.reshape(-1, 2))} if whole else {}

    def _charuco(self, cv2: Any, grey: np.ndarray) -> Corners:
        number = getattr(cv2.aruco, self.dictionary, None)
        if not isinstance(number, int) or not self.dictionary.startswith("DICT_"):
            raise D2Error(f"unknown marker dictionary '{self.dictionary}': name one of OpenCV's, such as DICT_4X4_50")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        needed, there = self.columns * self.rows // 2, len(dictionary.bytesList)
        if needed > there:
            raise D2Error(
                f"a board of {self.columns} x {self.rows} squares has {needed} markers and {self.dictionary} has "
                f"{there}: name the board's own dictionary"
            )
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = True
        for legacy in (False, True):  # boards of OpenCV before 4.6 begin with the other colour where rows are even
            board.setLegacyPattern(legacy)
            detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
            corners, identities, _, _ = detector.detectBoard(grey)
            if identities is not None:
                pairs = zip(identities.ravel().tolist(), corners.reshape(-1, 2), strict=True)
                return {number: corner + 0.5 for number, corner in pairs}
        return {}

    def ways(self, corners: Corners) -> list[Corners]:
        """The corners, and as they are if the board was seen the other way up, where its colours do not tell.

        OpenCV counts the corners of a plain board from a dark one, and it has two where columns + rows is even.
        """
        if self.marker is not None or (self.columns + self.rows) % 2:
            return [corners]
        last = (self.columns - 1) * (self.rows - 1) - 1
        return [corners, {last - number: corner for number, corner in corners.items()}]

    @classmethod
    def parsed(cls, text: str) -> Board:
        """The board of charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] or checkerboard:COLUMNSxROWS:SQUARE.

        Columns and rows count squares, as printed; sides are in metres.
        """
        side = r"(\d*\.?\d+(?:[eE]-?\d+)?)"
        size = r"(\d{1,3})x(\d{1,3})"
        match = re.fullmatch(rf"charuco:{size}:{side}:{side}(?::(\w+))?|checkerboard:{size}:{side}", text)
        with suppress(D2Error):
            if match is not None:
                columns, rows, square, *more = (group for group in match.groups() if group is not None)
                marker = float(more[0]) if more else None
                return cls(int(columns), int(rows), float(square), marker, *more[1:])
        raise D2Error(
            f"--board says '{text}', expected charuco:COLUMNSxROWS:SQUARE:MARKER such as charuco:7x5:0.04:0.03, or "
            "checkerboard:COLUMNSxROWS:SQUARE: count squares, 3 at least, and give their sides in metres"
        )


def seen_corners(images: Mapping[str, Sequence[np.ndarray]], board: Board) -> dict[str, list[Corners]]:
    """What each camera saw of the board at each moment."""
    return {name: [board.corners(image) for image in taken] for name, taken in images.items()}


def how_often(seen: Mapping[str, Sequence[Corners]]) -> str:
    """In how many of its images each camera saw the board, as a clause."""
    counts = (f"{name} in {sum(map(bool, taken))} of {len(taken)} images" for name, taken in seen.items())
    return f"the board was seen by {', '.join(counts)}"


def board_matches(
    features: Mapping[str, Features], seen: Mapping[str, Sequence[Corners]], board: Board
) -> tuple[dict[str, Features], Matches]:
    """(the features with the corners of the board behind them, which corners two cameras saw at the same moment).

    Where a board may be the other way up, both ways are matches: one motion over all moments explains the right one.
    """
    more, matches = {}, {}
    for name, taken in seen.items():  # moment 0 is what stands still
        moments = np.repeat(np.arange(1, len(taken) + 1), [len(corners) for corners in taken])
        more[name] = _with_corners(features[name], [one for corners in taken for one in corners.values()], moments)
    for one, other in combinations(seen, 2):
        begin, start = len(features[one].pixels), len(features[other].pixels)
        pairs = []
        for first, second in zip(seen[one], seen[other]):
            for way in board.ways(second):
                places = dict(zip(way, range(start, start + len(way))))
                pairs += [(begin + i, places[number]) for i, number in enumerate(first) if number in places]
            begin, start = begin + len(first), start + len(second)
        matches[one, other] = np.array(pairs, int).reshape(-1, 2)
    return {**features, **more}, matches


def _with_corners(features: Features, corners: Sequence[np.ndarray], moments: np.ndarray) -> Features:
    """Corners have no descriptor, so nothing else is taken for one; a size of 0 says that they stay where they are."""
    count = len(corners)
    return replace(
        features,
        pixels=np.concatenate([features.pixels, np.array(corners).reshape(-1, 2)]),
        descriptors=np.concatenate([features.descriptors, np.zeros((count, 128), np.float32)]),
        moments=np.concatenate([features.moments, moments]),
        shapes=np.concatenate([features.shapes, np.zeros((count, 2))]),
    )


@checked_arguments
def scaled_by_board(rig: SolvedRig, images: Mapping[str, Sequence[np.ndarray]], board: Board) -> SolvedRig:
    """The rig in the unit of the board, from the sides of squares between corners that two cameras saw.

    Raises:
        D2Error: no moment at which two cameras saw enough of the board, or sides that contradict each other.
    """
    seen = seen_corners({name: images[name] for name in rig.cameras}, board)
    sides: list[float] = []
    for corners in zip(*seen.values()):
        there = {name: board.ways(own) for name, own in zip(seen, corners) if own}
        trials = [_sides(rig, board, dict(zip(there, ways))) for ways in product(*there.values())]
        longest = max(trials, key=len)
        sides += longest
    if len(sides) < FEWEST_SIDES:
        raise D2Error(
            f"two cameras saw {len(sides)} sides of the board's squares at the same moment, expected {FEWEST_SIDES} at "
            f"least ({how_often(seen)}): show the whole board ({board.columns} x {board.rows} squares) to two cameras, "
            "larger and in focus"
        )
    low, middle, high = np.percentile(sides, [25, 50, 75])
    spread = float((high - low) / middle)
    if spread > LARGEST_SPREAD:
        raise D2Error(
            f"the sides of the board's squares differ by {spread:.0%}, expected {LARGEST_SPREAD:.0%} at most: hold it "
            "still and flat, and check that the cameras are synchronised"
        )
    why = f"from {len(sides)} sides of a board's squares, within {spread:.1%}; {how_often(seen)}"
    return rig.times(board.square / float(middle), why)


def _sides(rig: SolvedRig, board: Board, corners: Mapping[str, Corners]) -> list[float]:
    """Lengths between neighbouring corners of the board at one moment, in the unit of the rig."""
    names, across = tuple(rig.cameras), board.columns - 1
    numbers = sorted({number for own in corners.values() for number in own})
    features, rows = {}, np.full((len(numbers), len(names)), -1)
    for column, name in enumerate(names):
        own = corners.get(name, {})
        places = [i for i, number in enumerate(numbers) if number in own]
        rows[places, column] = np.arange(len(places))
        pixels = np.array([own[numbers[i]] for i in places]).reshape(-1, 2)
        features[name] = Features(pixels, np.zeros((len(places), 128), np.float32), np.zeros(len(places), int))
    bundle = fitting(triangulate(rig.cameras, features, Tracks(names, rows)), features, CORNER_ERROR)
    where = {tuple(row): number for row, number in zip(rows.tolist(), numbers, strict=True)}
    seen = map(tuple, bundle.tracks.seen.tolist())
    points = {where[row]: point for point, row in zip(bundle.points, seen, strict=True) if row in where}
    neighbours = [(n, n + 1) for n in points if (n + 1) % across] + [(n, n + across) for n in points]
    return [float(np.linalg.norm(points[a] - points[b])) for a, b in neighbours if a in points and b in points]

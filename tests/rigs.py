"""Made-up rigs for tests of calibration: what their cameras see of random things, and boards that they video."""

import zlib  # noqa: F401  (pycolmap brings a zlib of its own that must not come first)
from dataclasses import replace

import numpy as np
import pytest

from d2_plugin.recordings.cameras.calibrating import Board
from d2_plugin.recordings.cameras.calibrating.bundle import project
from d2_plugin.recordings.cameras.calibrating.features import Features
from d2_plugin.recordings.cameras.calibrating.rig import differences
from d2_plugin.recordings.cameras.camera import pinhole, rig_width, rigid
from d2_plugin.recordings.recording import Camera

pytest.importorskip("pycolmap", reason="pycolmap is in the `calibration` extra")
cv2 = pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")

NOISE = 0.2
"""Pixels, the standard deviation of a feature's place."""


def arc(cameras: int = 4, degrees: float = 25.0, scale: float = 1.0) -> dict[str, Camera]:
    """Cameras on an arc around the origin, `degrees` from one to the next, four units away; 640x480 times `scale`."""
    width, height = round(640 * scale), round(480 * scale)
    found = {}
    for number in range(cameras):
        angle = np.deg2rad(degrees * (number - (cameras - 1) / 2))
        R = cv2.Rodrigues(np.array([0.0, angle, 0]))[0] @ cv2.Rodrigues(np.array([0.05 * number, 0, 0.02]))[0]
        K = pinhole(600.0 * scale, 601.0 * scale, 322.0 * scale, 238.0 * scale)
        found[f"c{number}"] = Camera(f"c{number}", width, height, K, rigid(R, np.array([0, 0, 4.0])))
    return found


def seen_by(cameras: dict[str, Camera], things: int = 160, wrong: float = 0.15, seed: int = 0) -> dict[str, Features]:
    """What the cameras see of random things at two moments, as features; a share of them is matched wrongly."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (2, things, 3))
    names = rng.normal(size=(2, things, 128)).astype(np.float32)
    names /= np.linalg.norm(names, axis=-1, keepdims=True)
    found = {}
    for name, camera in cameras.items():
        pixels, moments = [], []
        for moment in (0, 1):
            exact = project(camera, points[moment])
            stray = rng.random(things) < wrong
            strayed = rng.uniform((0, 0), (camera.width, camera.height), (things, 2))
            pixels.append(np.where(stray[:, None], strayed, exact + rng.normal(0, NOISE, (things, 2))))
            moments.append(np.full(things, moment))
        found[name] = Features(np.concatenate(pixels), names.reshape(-1, 128), np.concatenate(moments))
    return found


def moved(cameras: dict[str, Camera], degrees: float, share: float, seed: int = 0) -> dict[str, Camera]:
    """Every camera turned by `degrees` about a random axis and moved by a `share` of the rig's width."""
    rng, width = np.random.default_rng(seed), rig_width(cameras.values())
    found = {}
    for name, camera in cameras.items():
        axis, shift = rng.normal(size=(2, 3))
        R = cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0] @ camera.T_camera_world[:3, :3]
        centre = camera.centre + share * width * shift / np.linalg.norm(shift)
        found[name] = replace(camera, T_camera_world=rigid(R, -R @ centre))
    return found


def worst(cameras: dict[str, Camera], truth: dict[str, Camera]) -> tuple[float, float]:
    """Largest (degrees, share of the rig's width) from the truth."""
    degrees, shares = zip(*differences(cameras, truth).values(), strict=True)
    return max(degrees), max(shares)


def filmed(
    rig: dict[str, Camera], square: float, plain: tuple[int, int] | None = None
) -> tuple[dict[str, list[np.ndarray]], Board]:
    """Images of a ChArUco board of 7 x 5 squares, or a plain one, that stands in front of the rig, and the board."""
    side = 60
    if plain is None:
        board = Board(7, 5, square, 0.75 * square)
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        drawn = cv2.aruco.CharucoBoard((7, 5), square, 0.75 * square, dictionary).generateImage((7 * side, 5 * side))
    else:
        board = Board(*plain, square)
        y, x = np.mgrid[: plain[1] * side, : plain[0] * side] // side
        drawn = np.where((x + y) % 2, 255, 0).astype(np.uint8)
    images = {}
    for name, camera in rig.items():
        T = camera.T_camera_world
        onto_plane = camera.K @ np.column_stack([T[:3, 0] * square / side, T[:3, 1] * square / side, T[:3, 3]])
        middle = np.array([[1, 0, -board.columns * side / 2], [0, 1, -board.rows * side / 2], [0, 0, 1.0]])
        half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])  # cv2 puts centres at whole numbers
        warp = half @ onto_plane @ middle @ np.linalg.inv(half)
        grey = cv2.warpPerspective(drawn, warp, (camera.width, camera.height), flags=cv2.INTER_AREA, borderValue=128)
        images[name] = [np.repeat(grey[..., None], 3, axis=2)]
    return images, board


def held(
    rig: dict[str, Camera], square: float, moments: int, plain: tuple[int, int] | None = None
) -> tuple[dict[str, list[np.ndarray]], Board]:
    """Images of a board at some places, in front of grey."""
    rng = np.random.default_rng(0)
    found: dict[str, list[np.ndarray]] = {name: [] for name in rig}
    for _ in range(moments):
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        turn[:3, 3] = rng.uniform(-0.35, 0.35, 3)
        moved = {name: replace(camera, T_camera_world=camera.T_camera_world @ turn) for name, camera in rig.items()}
        images, board = filmed(moved, square, plain)
        for name, taken in images.items():
            found[name] += taken
    return found, board

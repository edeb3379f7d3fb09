"""Rotation matrices from and to what calibration files hold: quaternions (w first) and rotation vectors."""

from __future__ import annotations

import numpy as np


def rotation_of_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] of a quaternion [4], w first, of any length but zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    if not length > 0:
        raise ValueError("a quaternion has length zero")
    if not length < np.inf:
        raise ValueError("a quaternion has a number without end")
    w, x, y, z = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of_rotation(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions [..., 4], w first and not negative, of the rotations nearest to `rotation` [..., 3, 3].

    It is the leading eigenvector of a symmetric matrix (Bar-Itzhack 2000), which loses no digits at any angle.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(np.asarray(rotation, np.float64), (-2, -1), (0, 1))
    symmetric = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    quaternion = np.linalg.eigh(np.moveaxis(np.array(symmetric), (0, 1), (-2, -1)))[1][..., -1]
    return np.where(quaternion[..., :1] >= 0, quaternion, -quaternion)


def rotation_of_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] about `vector` [3] by its length in radians (Rodrigues)."""
    half = float(np.linalg.norm(vector)) / 2
    axis = 0.5 * np.sinc(half / np.pi) * np.asarray(vector)  # sin(half) / (2 half), finite at 0
    return rotation_of_quaternion(np.array([np.cos(half), *axis]))

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
    """Unit quaternion [4], w first and not negative, of the rotation nearest to `rotation` [3, 3].

    It is the leading eigenvector of a symmetric matrix (Bar-Itzhack 2000), which loses no digits at any angle.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    symmetric = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    found = np.linalg.eigh(np.array(symmetric))[1][:, -1]
    return found if found[0] >= 0 else -found


def rotation_of_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] about `vector` [3] by its length in radians (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # sin(a) / a and (1 - cos(a)) / a^2, finite at a = 0; np.sinc(x) is sin(pi x) / (pi x).
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * (cross @ cross)

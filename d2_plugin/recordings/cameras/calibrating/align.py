"""One rig laid over another: a bundle is known up to a similarity, which the poses that were given settle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from d2_plugin.recordings.cameras.calibration import rigid
from d2_plugin.recordings.recording import Camera


def aligned(cameras: Mapping[str, Camera], onto: Mapping[str, Camera]) -> dict[str, Camera]:
    """`cameras` in the world of `onto`: rotated by the mean of the rotations between the two, scaled by their spreads.

    Rotations settle the turn because the centres of two cameras, or of several on a line, do not.
    """
    rotation, scale, shift = similarity(cameras, onto)
    found = {}
    for name, camera in cameras.items():
        R = camera.T_camera_world[:3, :3] @ rotation.T
        centre = scale * rotation @ camera.centre + shift
        found[name] = replace(camera, T_camera_world=rigid(R, -R @ centre))
    return found


def similarity(cameras: Mapping[str, Camera], onto: Mapping[str, Camera]) -> tuple[np.ndarray, float, np.ndarray]:
    """(R [3, 3], s, t [3]): x in the world of `cameras` is s R x + t in that of `onto`."""
    names = [name for name in cameras if name in onto]
    between = sum(onto[name].T_camera_world[:3, :3].T @ cameras[name].T_camera_world[:3, :3] for name in names)
    left, _, right = np.linalg.svd(between)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    here, there = (np.stack([rig[name].centre for name in names]) for rig in (cameras, onto))
    spread = np.linalg.norm(here - here.mean(axis=0))
    scale = float(np.linalg.norm(there - there.mean(axis=0)) / spread) if spread > 0 else 1.0
    return rotation, scale, there.mean(axis=0) - scale * rotation @ here.mean(axis=0)


def rig_width(cameras: Mapping[str, Camera]) -> float:
    """Largest distance between two cameras."""
    centres = np.stack([camera.centre for camera in cameras.values()])
    return float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())


def differences(cameras: Mapping[str, Camera], onto: Mapping[str, Camera]) -> dict[str, tuple[float, float]]:
    """Camera -> (degrees, share of the rig's width) that it differs by, once the rigs are laid over each other."""
    width = rig_width(onto) or 1.0
    laid = aligned(cameras, onto)
    found = {}
    for name in laid:
        turn = laid[name].T_camera_world[:3, :3] @ onto[name].T_camera_world[:3, :3].T
        sine = np.linalg.norm(turn - turn.T) / (2 * np.sqrt(2))  # accurate at small angles, as a cosine is not
        degrees = np.rad2deg(np.arctan2(sine, (np.trace(turn) - 1) / 2))
        found[name] = (float(degrees), float(np.linalg.norm(laid[name].centre - onto[name].centre) / width))
    return found

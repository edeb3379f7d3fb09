"""The images of one timestamp, hashes of everything that a depth depends on, and how a recording is known again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.recording import Camera, Recording


@dataclass(frozen=True, eq=False)
class Frame:
    """The synchronized images of one timestamp and their hashes, by camera."""

    number: int
    images: dict[str, np.ndarray]
    hashes: dict[str, str]
    recorded: dict[str, np.ndarray | None] = field(default_factory=dict)
    """Which pixels of each image were recorded; all where there is nothing."""

    @classmethod
    def read(cls, recording: Recording, cameras: Sequence[str], number: int) -> Frame:
        """Read the images of `cameras` at one frame."""
        images = {camera: recording.image(camera, number) for camera in cameras}
        recorded = {camera: recording.recorded(camera) for camera in cameras}
        hashes = {camera: _digest(image, recorded[camera]) for camera, image in images.items()}
        return cls(number, images, hashes, recorded)


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Name, size, K and pose as plain values, for records and hashes."""
    return {
        "name": camera.name,
        "size": [camera.width, camera.height],
        "K": np.asarray(camera.K, float).tolist(),
        "T_camera_world": np.asarray(camera.T_camera_world, float).tolist(),
    }


def describe_recording(recording: Recording) -> dict[str, Any]:
    """What a store says of its recording: the name for people, the calibrations of all its cameras."""
    cameras = {name: describe_camera(camera) for name, camera in recording.cameras.items()}
    return {"recording": recording.name, "calibrations": cameras}


def other_recording(found: dict[str, Any], given: dict[str, Any]) -> str | None:
    """Why two descriptions (`describe_recording`) are of different recordings; None if of one.

    The name decides only where one of them holds no calibration.
    """
    ours, theirs = given.get("calibrations"), found.get("calibrations")
    if not ours or not theirs:
        return None if found == given else ""
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        return "they have no camera in common"
    moved = [name for name in shared if not _same_camera(ours[name], theirs[name])]
    return f"camera {moved[0]} has another size, lens or pose" if moved else None


def not_of(path: Path, found: dict[str, Any], given: dict[str, Any], reason: str) -> D2Error:
    """The error for a store that belongs to another recording."""
    why = f" ({reason})" if reason else ""
    return D2Error(
        f"{path} holds the priors of {found.get('recording')}, not of {given.get('recording')}{why}: "
        "choose another output folder"
    )


def _same_camera(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Whether two calibrations are one, up to the last digits, which differ from machine to machine."""
    if ours["size"] != theirs["size"]:
        return False
    return all(np.allclose(ours[key], theirs[key], rtol=1e-6, atol=1e-9) for key in ("K", "T_camera_world"))


def digest(array: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    head = f"{array.dtype.str}{array.shape}".encode()
    return hashlib.blake2b(head + np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()


def view_digest(recording: Recording, camera: str, number: int) -> str:
    """Hash of the image of one camera at one frame, as `Frame.hashes` has it."""
    return _digest(recording.image(camera, number), recording.recorded(camera))


def _digest(image: np.ndarray, recorded: np.ndarray | None) -> str:
    return digest(image) if recorded is None else hash_of(digest(image), digest(recorded))


def hash_of(*parts: Any) -> str:
    """Hash of plain values, in an order that does not depend on dictionaries."""
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=16).hexdigest()

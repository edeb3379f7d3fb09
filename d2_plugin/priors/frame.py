"""The images of one timestamp with their hashes, and what a store records of a camera and a recording."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.store.files import hash_of


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
    return {"name": camera.name, **camera.calibration()}


def describe_recording(recording: Recording) -> dict[str, Any]:
    """What a store records of its recording: its name and the calibrations of all its cameras."""
    cameras = {name: describe_camera(camera) for name, camera in recording.cameras.items()}
    return {"recording": recording.name, "calibrations": cameras}


def digest(array: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    head = f"{array.dtype.str}{array.shape}".encode()
    return hashlib.blake2b(head + np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()


def view_digest(recording: Recording, camera: str, number: int) -> str:
    """Hash of the image of one camera at one frame, as `Frame.hashes` has it."""
    return _digest(recording.image(camera, number), recording.recorded(camera))


def _digest(image: np.ndarray, recorded: np.ndarray | None) -> str:
    return digest(image) if recorded is None else hash_of(digest(image), digest(recorded))

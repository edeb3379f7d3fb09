"""The pictures of one timestamp, and hashes of everything that a depth depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d2_plugin.captures.capture import Camera, Capture


@dataclass(frozen=True, eq=False)
class Frame:
    """The synchronized pictures of one timestamp and their hashes, by camera."""

    number: int
    images: dict[str, np.ndarray]
    hashes: dict[str, str]

    @classmethod
    def read(cls, capture: Capture, cameras: Sequence[str], number: int) -> Frame:
        """Read the pictures of `cameras` at one frame."""
        images = {camera: capture.image(camera, number) for camera in cameras}
        return cls(number, images, {camera: digest(image) for camera, image in images.items()})


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Name, size, K and pose as plain values, for records and hashes."""
    return {
        "name": camera.name,
        "size": [camera.width, camera.height],
        "K": np.asarray(camera.K, float).tolist(),
        "T_camera_world": np.asarray(camera.T_camera_world, float).tolist(),
    }


def digest(array: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    head = f"{array.dtype.str}{array.shape}".encode()
    return hashlib.blake2b(head + np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()


def hash_of(*parts: Any) -> str:
    """Hash of plain values, in an order that does not depend on dictionaries."""
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=16).hexdigest()

"""Maps of numbers that lie beside the images, as .npy or 16-bit .png, brought to the image's size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.priors.extras import opencv
from d2_plugin.priors.geometry import viewing_rays
from d2_plugin.recordings.images import read_numbers, shrink_depth
from d2_plugin.recordings.recording import Camera

SUFFIXES = (".npy", ".png")
"""Of the files that are read."""

ASPECT = 0.01
"""Sensor and image may differ by this share in their ratio of width to height: a pixel or two of rounding."""


def stored_numbers(path: Path) -> np.ndarray:
    """A map as it is stored, [h, w]."""
    if path.suffix == ".npy":
        values = read_array(path, "replace the file or remove it")
    else:
        opencv("reading sensor depth")
        values = read_numbers(path)
        if values.dtype != np.uint16:
            found = f"{values.dtype} with shape {values.shape}"
            raise D2Error(f"{path} is {found}: sensor depth needs a PNG of 16 bits and one channel, or .npy")
    if values.ndim != 2 or values.size == 0:
        raise D2Error(f"{path} has shape {values.shape}, expected [height, width]: write one number per pixel")
    return values


def at_image_size(depth: np.ndarray, camera: Camera, path: Path) -> np.ndarray:
    """The map at the camera's size: blocks where the image was made smaller by a whole number, else nearest pixels.

    Nearest on purpose: a depth interpolated across an edge belongs to no surface.
    """
    height, width = depth.shape
    factor = width // camera.width
    if factor >= 1 and width - factor * camera.width < factor and 0 <= height - factor * camera.height < factor:
        return shrink_depth(depth, factor) if factor > 1 else depth.astype(np.float32)
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT:
        raise D2Error(
            f"{path} is {width}x{height} but its image {camera.width}x{camera.height}: register the depth map to the "
            "image of its camera first"
        )
    rows = ((np.arange(camera.height) + 0.5) * (height / camera.height)).astype(np.int64)
    columns = ((np.arange(camera.width) + 0.5) * (width / camera.width)).astype(np.int64)
    return np.ascontiguousarray(depth[rows][:, columns], dtype=np.float32)


def planar(distance: np.ndarray, camera: Camera) -> np.ndarray:
    """Planar z float32 [H, W] of distances along the ray from the camera's centre: z = d / |K^-1 (u, v, 1)|."""
    return (distance / np.linalg.norm(viewing_rays(camera), axis=-1)).astype(np.float32)

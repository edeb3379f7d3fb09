"""Maps of numbers that lie beside the images, as .npy or 16-bit .png, brought to the image's size; confidence maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import viewing_rays
from d2_plugin.recordings.files import files_by_camera
from d2_plugin.recordings.images import opencv, read_numbers, shrink_depth
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
            raise D2Error(
                f"{path} is {values.dtype} with shape {values.shape}: sensor depth needs a PNG of 16 bits and one "
                "channel, or .npy"
            )
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


FULL = 65535
"""The 16-bit number that stands for a confidence of 1."""
OF_DEPTH, OF_MONO = "depth_confidence", "mono_confidence"
"""Folders beside the images: of geometric depth on disk, and of monocular maps."""


class ConfidenceMaps:
    """A source's own confidence, in one folder; a folder that is not there has none. An addition to the paper.

        FOLDER/CAMERA/FRAME.npy      [H, W], 0..1
        FOLDER/CAMERA/FRAME.png      16 bits, one channel, 65535 stands for 1

    A confidence c tells how errors are spread over an image, not how large they are: the declared sigma is divided by
    c, so a pixel at .5 may be twice as wrong as one at 1, and one at 0 is no depth at all. Without a map c is 1.
    """

    def __init__(self, folder: Path, cameras: Sequence[str]) -> None:
        self.files = files_by_camera(folder, cameras, SUFFIXES)

    @classmethod
    def beside(cls, recording_folder: Path | None, name: str, cameras: Sequence[str]) -> ConfidenceMaps:
        """Those in the folder `name` of a recording, none where the recording lies on no disk."""
        return cls(recording_folder / name, cameras) if recording_folder is not None else cls(Path(), ())

    def of(self, camera: Camera, frame: int) -> np.ndarray | None:
        """Confidence float32 [H, W] in 0..1 at the camera's size, or None: no map, which is 1 everywhere.

        Raises:
            D2Error: a map that cannot be read, or with values outside of 0..1.
        """
        path = self.files.get(camera.name, {}).get(frame)
        if path is None:
            return None
        stored = stored_numbers(path).astype(np.float32)
        values = stored / np.float32(FULL) if path.suffix == ".png" else stored
        if not ((values >= 0) & (values <= 1)).all():
            raise D2Error(f"{path} has values from {values.min():g} to {values.max():g}: a confidence is in 0..1")
        return at_image_size(values, camera, path)


def divided(sigma: np.ndarray, confidence: np.ndarray | None) -> np.ndarray:
    """Sigma float32 [H, W] over the confidence; infinite where that is 0."""
    if confidence is None:
        return sigma
    sure = confidence > 0
    return np.where(sure, sigma / np.where(sure, confidence, 1), np.float32(np.inf)).astype(np.float32)

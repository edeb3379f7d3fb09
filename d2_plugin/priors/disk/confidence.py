"""A source's own confidence: maps beside those of a sensor, a workspace or a network; an addition to the paper.

    FOLDER/CAMERA/FRAME.npy      [H, W], 0..1
    FOLDER/CAMERA/FRAME.png      16 bits, one channel, 65535 stands for 1

A confidence c says how errors are spread over an image, not how large they are: the declared sigma is divided by c, so
a pixel at .5 may be twice as wrong as one at 1, and one at 0 is no depth at all. Where there is no map, c is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.disk.stored import SUFFIXES, at_image_size, stored_numbers
from d2_plugin.recordings.files import FrameFiles, numbered_files
from d2_plugin.recordings.recording import Camera

FULL = 65535
"""What a 16-bit number is divided by."""
OF_DEPTH, OF_MONO = "depth_confidence", "mono_confidence"
"""Folders beside the images: of geometric depth on disk, and of monocular maps."""


class ConfidenceMaps:
    """The confidence maps of one folder; a folder that is not there has none."""

    def __init__(self, folder: Path, cameras: Sequence[str]) -> None:
        self.files: dict[str, FrameFiles] = {
            name: numbered_files(folder / name, SUFFIXES) for name in cameras if (folder / name).is_dir()
        }

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

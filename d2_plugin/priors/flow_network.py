"""Optical flow from an ONNX network of two images, as RAFT and its successors are exported, in place of OpenCV's DIS.

Only what dense flow says comes from the network. What it does not follow is found by the same means as ever
(`d2_plugin.priors.scene_flow`), and flow that does not return, or shows other colours, is not believed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.frame import digest
from d2_plugin.priors.monocular.network import hash_of_files, opened
from d2_plugin.priors.settings import FlowRange
from d2_plugin.reading import parsing
from d2_plugin.recordings.images import opencv
from d2_plugin.store.files import EntryFolder, hash_of
from d2_plugin.values import shown

STEP, LEAST = 8, 128
"""Free sides are multiples of the first, and the second at least, of which RAFT makes two pixels in six halvings."""


class FlowNetwork:
    """A network that is given two RGB images and returns the flow from the first to the second.

    Args:
        path: an ONNX file with two inputs [1, 3, H, W], of a fixed or a free size, and an output [1, 2, H, W]: columns
            and rows, in pixels of that size. Of several such outputs the last is taken.
        values: what an image's values are: `bytes` (RAFT's own code, SEA-RAFT, OpenCV's model zoo), `signed`
            (torchvision's RAFT) or `unit`.
        threads: of one inference; 0 leaves the number to onnxruntime.

    Raises:
        D2Error: no such file, no ONNX network, or other inputs.
        MissingExtra: onnxruntime is not installed.
    """

    def __init__(self, path: Path | str, values: FlowRange = "bytes", threads: int = 1) -> None:
        self.path, self.values = Path(path), values
        self.session = opened(self.path, threads, "optical flow")
        inputs = self.session.get_inputs()
        if len(inputs) != 2 or any(len(each.shape) != 4 or each.shape[1] not in (3, None) for each in inputs):
            raise D2Error(
                f"{path} takes {', '.join(shown(each.shape) for each in inputs)}: export a network of optical flow "
                "whose two inputs are [1, 3, H, W]"
            )
        self._names = [each.name for each in inputs]
        self._type = np.float16 if inputs[0].type == "tensor(float16)" else np.float32
        self._size = [side if isinstance(side, int) and side > 0 else None for side in inputs[0].shape[2:]]
        self.fingerprint = hash_of(hash_of_files(self.path), self.session.get_providers()[0], values)

    def flow(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Flow [H, W, 2] (columns, rows) in pixels, float32, from one RGB uint8 image [H, W, 3] to another."""
        cv2, (height, width) = opencv("scene flow"), image.shape[:2]
        enlarge = max(1.0, LEAST / min(height, width))
        rows, columns = (
            fixed or STEP * round(enlarge * side / STEP) for fixed, side in zip(self._size, (height, width))
        )
        pair = [self._prepared(cv2.resize(each, (columns, rows))) for each in (image, other)]
        with parsing(f"what {self.path} makes of two images of {columns}x{rows}", "export the network for this size"):
            outputs: list[Any] = self.session.run(None, dict(zip(self._names, pair)))
        flows = [each for each in outputs if np.shape(each) == (1, 2, rows, columns)]
        if not flows:
            raise D2Error(
                f"{self.path} returns {', '.join(shown(np.shape(each)) for each in outputs)} for images of "
                f"{columns}x{rows}: export a network of optical flow that returns [1, 2, {rows}, {columns}]"
            )
        flow = np.nan_to_num(np.moveaxis(flows[-1][0].astype(np.float32), 0, -1), posinf=0, neginf=0)
        return np.asarray(cv2.resize(flow, (width, height))) * np.array([width / columns, height / rows], np.float32)

    def kept(self, entries: EntryFolder, camera: str, frame: int, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """The same from the image of one frame of a camera, kept in a folder: an inference may take seconds."""
        key = hash_of(self.fingerprint, digest(image), digest(other))
        entry = entries.find_current(camera, frame, key)
        if entry is not None:
            return entry.array()
        flow = self.flow(image, other)
        entries.write(camera, frame, flow, {"key": key})
        return flow

    def _prepared(self, image: np.ndarray) -> np.ndarray:
        """The input [1, 3, h, w] for an RGB uint8 image of its size."""
        planes = np.moveaxis(image, -1, 0)[None].astype(np.float32)
        ranged = {"bytes": planes, "unit": planes / 255, "signed": planes / 127.5 - 1}[self.values]
        return np.ascontiguousarray(ranged, dtype=self._type)

"""Monocular depth from any ONNX network through onnxruntime, with Depth Anything V2's conventions built in.

What a network predicts cannot be read from its file, so `kind` must be declared: `relative` is affine-invariant inverse
depth (Depth Anything V2 ends in a ReLU: zeros are legal, the range is arbitrary), `metric` is depth.
"""

from __future__ import annotations

import hashlib
import logging
import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import imported
from d2_plugin.priors.settings import Preprocessing
from d2_plugin.reading import parsing
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import MonoKind
from d2_plugin.values import counted, shown

PATCH = 14  # side of a ViT patch: Depth Anything V2 takes sizes that are multiples of it
LARGEST_INPUT = 8192  # pixels: a network that was exported for more fills the memory
SHORT_SIDE = 518  # Depth Anything V2's lower bound of the shorter side, pixels
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class NetworkInput:
    """The image input of a session; `height` or `width` is None where the size is free."""

    name: str
    height: int | None
    width: int | None
    dtype: type
    leading: int = 1
    """Axes in front of the channels."""

    @classmethod
    def of(cls, session: Any, path: Path, views: int | None = None) -> NetworkInput:
        """The only input of a session, of one image or of so many `views` of an instant.

        Raises:
            D2Error: more than one input, another layout than [1, 3, H, W] or [1, V, 3, H, W], another number of
                views, or other numbers than floats.
        """
        inputs, layout = session.get_inputs(), "[1, 3, H, W]" if views is None else "[1, V, 3, H, W] or [V, 3, H, W]"
        if len(inputs) != 1:
            raise D2Error(f"{path} has {len(inputs)} inputs: export a network with one image input {layout}")
        whole, dtypes = inputs[0].shape, {"tensor(float)": np.float32, "tensor(float16)": np.float16}
        shape = whole[1:] if views is not None and len(whole) == 5 else whole
        # Channels come last where three pixels are all that a row would have.
        if len(shape) != 4 or (shape[1] not in (3, None) and isinstance(shape[1], int)) or shape[3] == 3 != shape[1]:
            raise D2Error(f"{path} takes {shown(whole)}: export a network whose input is {layout}")
        if views is not None and isinstance(shape[0], int) and shape[0] != views:
            raise D2Error(
                f"{path} was exported for {counted(shape[0], 'view')} and would be wrong for {views} without saying "
                f"so: train with {counted(shape[0], 'camera')}, or export it for {views}"
            )
        if views is None and isinstance(shape[0], int) and shape[0] > 1:
            raise D2Error(f"{path} takes {shape[0]} images at once: export it with a batch of 1, or of free size")
        if inputs[0].type not in dtypes:
            raise D2Error(f"{path} takes {inputs[0].type}: export a network that takes float32 or float16")
        if max((size for size in shape[2:] if isinstance(size, int)), default=0) > LARGEST_INPUT:
            raise D2Error(
                f"{path} takes images of {shape[3]}x{shape[2]}, expected at most {LARGEST_INPUT} a side: export it "
                "for a smaller input, or a free one"
            )
        height, width = (size if isinstance(size, int) and size > 0 else None for size in shape[2:])
        return cls(inputs[0].name, height, width, dtypes[inputs[0].type], len(whole) - 3)


class MonocularModel:
    """A monocular depth network; call it with an image.

    Args:
        kind: `relative` (inverse depth) or `metric` (depth).
        preprocessing: `depth_anything_v2` (cubic resize, ImageNet mean and deviation), `unit` (0..1), or `auto`.
        threads: of one inference; one per worker process is fastest for frames that are independent.
        views: how many views of an instant it sees at once; None for a network of one image.

    Raises:
        D2Error: no such file, no ONNX network, or an input that is no image.
        MissingExtra: onnxruntime is not installed.
    """

    def __init__(
        self,
        path: Path | str,
        kind: MonoKind,
        preprocessing: Preprocessing = "auto",
        threads: int = 1,
        views: int | None = None,
    ) -> None:
        self.path, self.kind = Path(path), kind
        self.session = opened(self.path, threads, "monocular depth")
        self.input = NetworkInput.of(self.session, self.path, views)
        self.preprocessing = _recognised(self.input) if preprocessing == "auto" else preprocessing
        self.provider = self.session.get_providers()[0]
        logger.info("%s: %s, preprocessing %s", self.path.name, self.provider, self.preprocessing)

    def predict(self, image: np.ndarray) -> np.ndarray:
        """The prediction for an RGB uint8 image [H, W, 3], float32 [h, w] at the size the network returns."""
        output = next(iter(self.arrays([image]).values()))
        prediction = np.squeeze(output, axis=tuple(axis for axis in range(output.ndim - 2) if output.shape[axis] == 1))
        if prediction.ndim != 2 or min(prediction.shape) < 2:
            raise D2Error(f"{self.path} returns {output.shape}: expected one map [1, H, W] or [1, 1, H, W]")
        return prediction

    def arrays(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """All outputs of the network for the views of one instant, by their names."""
        tensor = np.concatenate([self.prepare(image) for image in images])
        tensor = tensor.reshape((1,) * (self.input.leading - 1) + tensor.shape)
        height, width = tensor.shape[-2:]
        with parsing(f"what {self.path} makes of an image of {width}x{height}", "export the network for this size"):
            outputs = self.session.run(None, {self.input.name: tensor})
            return {out.name: np.asarray(a, np.float32) for out, a in zip(self.session.get_outputs(), outputs)}

    def prepare(self, image: np.ndarray) -> np.ndarray:
        """The network's input [1, 3, h, w] for an RGB uint8 image."""
        cv2 = opencv("monocular depth")
        height, width = self.input_size(*image.shape[:2])
        unit = image.astype(np.float32) / 255
        if self.preprocessing == "depth_anything_v2":
            unit = (cv2.resize(unit, (width, height), interpolation=cv2.INTER_CUBIC) - IMAGENET_MEAN) / IMAGENET_STD
        else:
            shrinks = width < image.shape[1]
            unit = cv2.resize(unit, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return np.ascontiguousarray(unit.transpose(2, 0, 1)[None], dtype=self.input.dtype)

    def input_size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width that an image of this size is resized to: the network's own, or 518 on the short side."""
        rows, columns = self.input.height, self.input.width
        if rows and columns:
            return rows, columns
        enlarge = rows / height if rows else columns / width if columns else SHORT_SIDE / min(height, width)
        rows, columns = rows or _multiple_of_patch(height * enlarge), columns or _multiple_of_patch(width * enlarge)
        if max(rows, columns) > LARGEST_INPUT:
            raise D2Error(
                f"an image of {width}x{height} would enter {self.path} as {columns}x{rows}, at most {LARGEST_INPUT} a "
                "side: give a network of fixed size, or images that are less long"
            )
        return rows, columns

    def fingerprint(self) -> str:
        """What the prediction depends on besides the image: files, provider and preprocessing."""
        return hash_of_files(self.path, f"{self.provider} {self.preprocessing}")


def hash_of_files(network: Path, more: str = "") -> str:
    """Of an ONNX file, the weights beside it, and `more`."""
    digest = hashlib.sha256()
    for path in (network, *external_weights(network)):
        with path.open("rb") as file:
            while chunk := file.read(1 << 22):
                digest.update(chunk)
    digest.update(more.encode())
    return digest.hexdigest()[:32]


def external_weights(path: Path) -> list[Path]:
    """The files beside an ONNX file that hold weights of it, as networks above 2 GB keep them.

    A tensor names its file in an entry of protobuf with key `location` (onnx.proto, TensorProto.external_data): field 1
    is the key, field 2 the name, each behind its length.
    """
    entry, names = b"\x0a\x08location\x12", set()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        place = content.find(entry)
        while place >= 0:
            length, start = _varint(content, place + len(entry))
            names.add(content[start : start + length])
            place = content.find(entry, start)
    files = (path.parent / os.fsdecode(name) for name in sorted(names) if name and b"\0" not in name)
    return [file for file in files if file.is_file()]


def _varint(content: mmap.mmap, place: int) -> tuple[int, int]:
    """The number that protobuf wrote at a place, seven bits a byte, and the place behind it."""
    value, shift = 0, 0
    while place < len(content) and shift < 63:
        byte = content[place]
        value, place, shift = value | (byte & 127) << shift, place + 1, shift + 7
        if byte < 128:
            break
    return value, place


def upsample(prediction: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear with aligned corners, as Depth Anything V2 does it: the outermost samples stay outermost. float32."""
    if prediction.shape == (height, width):
        return prediction.astype(np.float32)
    rows, row_share = _aligned(prediction.shape[0], height)
    columns, column_share = _aligned(prediction.shape[1], width)
    source = prediction.astype(np.float32)
    upper, lower = source[rows], source[np.minimum(rows + 1, source.shape[0] - 1)]
    with np.errstate(invalid="ignore", over="ignore"):  # between two infinities, as in a sky, there is one
        lines = np.where(upper == lower, upper, upper + (lower - upper) * row_share[:, None])
        # take keeps rows together, where lines[:, columns] would return columns: ten passes over the map follow.
        left, right = (lines.take(at, axis=1) for at in (columns, np.minimum(columns + 1, source.shape[1] - 1)))
        return np.where(left == right, left, left + (right - left) * column_share)


def _aligned(small: int, large: int) -> tuple[np.ndarray, np.ndarray]:
    position = np.linspace(0, small - 1, large)
    before = np.minimum(position.astype(np.int64), max(small - 2, 0))
    return before, (position - before).astype(np.float32)


def _multiple_of_patch(size: float) -> int:
    return max(PATCH, round(size / PATCH) * PATCH)


def _recognised(network: NetworkInput) -> str:
    """`depth_anything_v2` where the input size is free or a multiple of its patch, `unit` otherwise."""
    sizes = [size for size in (network.height, network.width) if size is not None]
    return "depth_anything_v2" if all(size % PATCH == 0 for size in sizes) else "unit"


def opened(path: Path, threads: int, of: str) -> Any:
    """The session of an ONNX file `of` something, on the GPU where onnxruntime has one."""
    onnxruntime = imported("onnxruntime", "onnxruntime", "mono", f"{of} from an ONNX file")
    if not path.is_file():
        raise D2Error(f"no network of {of} at {path}: give the path of an ONNX file")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Spinning threads take the time of whatever runs beside them.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    available = onnxruntime.get_available_providers()
    providers = [name for name in ("CUDAExecutionProvider", "CPUExecutionProvider") if name in available]
    with parsing(f"{path} as an ONNX network", "give one that onnxruntime can run"):
        return onnxruntime.InferenceSession(str(path), options, providers=providers)

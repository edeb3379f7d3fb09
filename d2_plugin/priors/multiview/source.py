"""Where multi-view depth comes from, files or a network in ONNX, and how it gets the one scale of the recording."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.frame import Frame, digest
from d2_plugin.priors.maps_on_disk import planar
from d2_plugin.priors.monocular.network import MonocularModel
from d2_plugin.priors.multiview.moving import Instant, follow_images
from d2_plugin.priors.multiview.predicted import Predicted, declared, prediction_files, read_prediction, understood
from d2_plugin.priors.multiview.scale import log_ratio, turned_by, world_scale
from d2_plugin.priors.scene_flow import STILL_INSTANTS
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.store.files import EntryFolder, hash_of
from d2_plugin.values import counted, shown

log = logging.getLogger(__name__)

VERSION = 1  # raise it when this file changes what it returns, so that caches are not trusted
SCALED_AT = 3
"""At so many instants, spread over the recording, its scale is measured; their median counts."""
CROPPED = 0.05
"""Maps and images may differ by this share in their ratio of width to height: networks round to patches of 14."""

TURNED = 10.0
"""Degrees by which no network's poses are off that saw these cameras in this order."""

CAMERAS = ("poses", "intrinsics")
"""What is cached of a prediction beside its maps."""


class MultiviewMap(NamedTuple):
    """Depth of one view, in the recording's one scale."""

    depth: np.ndarray
    """Planar, float32 [H, W], NaN where there is none."""
    confidence: np.ndarray
    """float32 [H, W] in a unit of the network's own, 0 where there is no depth."""


def multiview_about(path: Path) -> str:
    """The source as a person reads it."""
    emulated = path.is_dir() and declared(path).get("emulated") is True
    return f"depth of all views from {path.name}{' (emulated)' if emulated else ''}"


class MultiviewSource:
    """Multi-view depth of a recording.

    Args:
        cache: folder for the predictions of an ONNX network.

    Raises:
        D2Error: no such files or network, or a network for another number of views.
    """

    def __init__(
        self,
        recording: Recording,
        names: Sequence[str],
        settings: PriorSettings,
        cache: Path,
        read: Callable[[int], Frame],
    ) -> None:
        path, self.settings, self.read = Path(settings.multiview or ""), settings, read
        self.cameras = {name: camera for name, camera in recording.cameras.items() if name in names}
        self.frames, self.model = recording.frames, None
        self.orders = [list(self.cameras), list(recording.cameras)]
        self._read = functools.lru_cache(maxsize=2)(self._found)
        self._scale: tuple[float, Predicted] | None = None
        if path.suffix.lower() == ".onnx":
            self.model = MonocularModel(
                path, "metric", settings.mono_preprocessing, settings.mono_threads, views=len(self.cameras)
            )
            self.files, self._fingerprint = {}, self.model.fingerprint()
        else:
            self.files = prediction_files(path)
            self._name_missing(path)
            self._read_order(declared(path).get("cameras"), path)
        self.entries = EntryFolder(cache, synced=False)
        self.about = multiview_about(path)

    def _name_missing(self, folder: Path) -> None:
        missing = [frame for frame in self.frames if frame not in self.files]
        if len(missing) == len(self.frames):
            raise D2Error(
                f"{folder} has frames {min(self.files)} to {max(self.files)} and none of the recording's, "
                f"{self.frames[0]} to {self.frames[-1]}: name each file like the images of its instant"
            )
        if missing:
            frames = counted(len(self.frames), "frame")
            log.warning("%s lacks %d of %s, frame %d first", folder, len(missing), frames, missing[0])

    def _read_order(self, cameras: Any, folder: Path) -> None:
        if cameras is None:
            return
        if not isinstance(cameras, list) or not cameras:
            raise D2Error(f"{folder}/multiview.json has cameras {shown(cameras)}, expected a list of names: correct it")
        missing = [name for name in self.cameras if name not in cameras]
        if missing:
            raise D2Error(f"{folder}/multiview.json lacks camera '{missing[0]}', it has {shown(cameras)}: correct it")
        self.orders = [cameras]

    def has(self, frame: int) -> bool:
        """Whether there is anything of this frame."""
        return self.model is not None or frame in self.files

    def key(self, frame: Frame) -> str:
        """Hash of all that the maps of a frame depend on."""
        if not self.has(frame.number):
            return "none"
        prediction, settings = self._predicted(frame.number), self.settings
        arrays = [None if array is None else digest(array) for array in prediction]
        factor = round(self._factor(frame.number), 12)
        return hash_of(VERSION, arrays, settings.multiview_scale, settings.multiview_along, factor)

    def views(self, frame: Frame) -> dict[str, MultiviewMap]:
        """The maps of one frame at the images' sizes, by camera; none where the network saw no such frame."""
        if not self.has(frame.number):
            return {}
        prediction, factor = self._predicted(frame.number), self._factor(frame.number)
        return {
            name: self._brought(camera, prediction, place, factor)
            for place, (name, camera) in enumerate(self.cameras.items())
        }

    def _brought(self, camera: Camera, prediction: Predicted, place: int, factor: float = 1.0) -> MultiviewMap:
        """One view at its camera's size. What a network matched fixes depth over focal length, so its own goes out."""
        cv2, size = opencv("multi-view depth"), (camera.width, camera.height)
        depth = prediction.depth[place]
        stretched = depth.shape[1] * camera.height / (depth.shape[0] * camera.width)
        if abs(stretched - 1) > CROPPED:
            raise D2Error(
                f"multi-view maps of {depth.shape[1]}x{depth.shape[0]} do not belong to images of {size[0]}x{size[1]} "
                f"(camera {camera.name}): export them without cropping or padding"
            )
        if prediction.intrinsics is not None:
            focal = float(prediction.intrinsics[place][0, 0])
            factor = factor * camera.K[0, 0] * depth.shape[1] / camera.width / focal if focal > 0 else factor
        enlarged = cv2.resize(np.float32(factor) * depth, size, interpolation=cv2.INTER_LINEAR)
        enlarged = planar(enlarged, camera) if self.settings.multiview_along == "ray" else enlarged
        sure = cv2.resize(prediction.confidence[place], size, interpolation=cv2.INTER_LINEAR)
        return MultiviewMap(enlarged, np.where(np.isfinite(enlarged), sure, 0))

    def _factor(self, number: int) -> float:
        """What brings the maps of a frame to the recording's scale: what stands still is as far as at the first."""
        if self.settings.multiview_scale == "metric":
            return 1.0
        if self._scale is None:
            there = [frame for frame in self.frames if self.has(frame)]
            first, some = self._predicted(there[0]), spread(there, SCALED_AT)
            if not any(np.isfinite(self._predicted(frame).depth).any() for frame in some):
                looked = ", ".join(map(str, some))
                log.warning("%s: frames %s have no pixel with depth and confidence above 0", self.about, looked)
            logs = np.array([self._measured(frame, first) for frame in some])
            logs = logs[np.isfinite(logs)]
            self._scale = float(np.median(logs)) if logs.size else 0.0, first
            self._name_other_order(first)
        scale, first = self._scale
        return float(np.exp(scale - self._against(number, first)))

    def _name_other_order(self, first: Predicted) -> None:
        off = 0.0 if first.poses is None else turned_by(first.poses, list(self.cameras.values()))
        if off > TURNED:
            log.warning(
                "%s: the network's poses are turned by up to %.0f degrees from the cameras %s: if it saw the views in "
                "another order, say so in multiview.json", self.about, off, ", ".join(self.cameras),
            )  # fmt: skip

    def _against(self, number: int, first: Predicted) -> float:
        now = self._predicted(number).depth
        if now.shape != first.depth.shape:
            raise D2Error(
                f"multi-view maps of frame {number} are {now.shape} and those of the first {first.depth.shape}: export "
                "all at one size"
            )
        return log_ratio(now, first.depth)

    def _measured(self, number: int, first: Predicted) -> float:
        """Log of the scale of the recording from one frame; NaN where it does not tell."""
        prediction = self._predicted(number)
        brought = {name: self._brought(c, prediction, i) for i, (name, c) in enumerate(self.cameras.items())}
        maps = {name: surer_half(*map_) for name, map_ in brought.items()}
        return float(np.log(world_scale(maps, self.cameras, prediction.poses))) + self._against(number, first)

    def _predicted(self, number: int) -> Predicted:
        """The prediction of one frame; nothing of what moves where the maps do not show that at their instants."""
        found, still = self._read(number), self._still
        if still is None:
            return found
        changed = np.logical_or(*self._instant(number).changes(still))
        grown = [opencv("multi-view depth").dilate(view.astype(np.uint8), np.ones((3, 3))) for view in changed]
        return found._replace(confidence=np.where(np.stack(grown), np.float32(0), found.confidence))

    @functools.cached_property
    def _still(self) -> Instant | None:
        """What stands still, if what moves in the maps is not what moves in the images."""
        some = spread([frame for frame in self.frames if self.has(frame)], STILL_INSTANTS)
        if len(some) < 4:
            return None  # what stands still is not known
        instants = [self._instant(frame) for frame in some]
        still = Instant(*(np.median(parts, axis=0) for parts in zip(*instants)))
        if follow_images(*zip(*(instant.changes(still) for instant in instants))):
            return None
        log.warning(
            "%s: what moves in the maps is not what moves in the images, so they are used for what stands still alone: "
            "check that each file has the number of its frame", self.about,
        )  # fmt: skip
        return still

    def _instant(self, number: int) -> Instant:
        cv2, depth, images = opencv("multi-view depth"), self._read(number).depth, self.read(number).images
        first = self._read(next(frame for frame in self.frames if self.has(frame))).depth
        size = depth.shape[:0:-1]
        small = [cv2.resize(images[name], size, interpolation=cv2.INTER_AREA) for name in self.cameras]
        return Instant(np.stack(small).astype(np.float32), np.log(depth) - log_ratio(depth, first))

    def _found(self, number: int) -> Predicted:
        """The prediction of one frame, of the training cameras in their order."""
        return self._computed(number) if self.model is not None else self._stored(self.files[number])

    def _stored(self, path: Path) -> Predicted:
        prediction = read_prediction(path, tuple(dict.fromkeys(len(order) for order in self.orders)))
        order = next(order for order in self.orders if len(order) == len(prediction.depth))
        places = [order.index(name) for name in self.cameras]
        poses, intrinsics = (None if array is None else array[places] for array in prediction[2:])
        return Predicted(prediction.depth[places], prediction.confidence[places], poses, intrinsics)

    def _computed(self, number: int) -> Predicted:
        """What the network says, computed once; depth and confidence are kept, and its poses beside them."""
        assert self.model is not None
        frame = self.read(number)
        images = [frame.images[name] for name in self.cameras]
        key = hash_of(VERSION, self._fingerprint, [frame.hashes[name] for name in self.cameras])
        entry = self.entries.find_current("all", number, key)
        if entry is None:
            found = understood(self.model.arrays(images), str(self.model.path), (len(images),))
            small = {name: None if a is None else a.tolist() for name, a in found._asdict().items() if name in CAMERAS}
            maps = np.stack([found.depth, found.confidence])
            self.entries.write("all", number, maps, {"key": key, "about": self.about} | small)
            return found
        depth, sure = entry.array()
        return Predicted(depth, sure, *(None if (a := entry.record[name]) is None else np.array(a) for name in CAMERAS))


def surer_half(depth: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Depth [H, W] where confidence is not below its median, NaN elsewhere: without skies and edges."""
    known = confidence[confidence > 0]
    return np.where(confidence >= np.median(known), depth, np.float32(np.nan)) if known.size else depth

"""The two depths that D* is made of, each with a cache on disk: monocular maps and geometric depth of one frame."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from d2_plugin.captures.capture import Camera, Capture, MonoKind
from d2_plugin.errors import D2Error
from d2_plugin.priors.depth_on_disk import RecordedDepth, filter_recorded
from d2_plugin.priors.files import EntryFolder
from d2_plugin.priors.monocular.network import MonocularModel, upsample
from d2_plugin.priors.settings import PriorSettings, StereoSettings
from d2_plugin.priors.stereo.filter import GeometricDepth
from d2_plugin.priors.stereo.geometric_depth import WHOLE_PICTURES, DepthBounds, choose_maker, geometric_depth
from d2_plugin.priors.stereo.reuse import MatchMemory
from d2_plugin.priors.store import DepthRange

STEREO_VERSION = 1  # raise it when makers or filter change what they return, so that caches are not trusted
MONO_VERSION = 1


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


class MonoSource(Protocol):
    """Where monocular maps come from."""

    kind: MonoKind
    about: str

    def key(self, camera: str, frame: Frame) -> str:
        """Hash of everything the map depends on."""

    def map(self, camera: str, frame: Frame) -> np.ndarray | None:
        """The map float32 [H, W] at the picture's size, or None where there is none."""


class MapsOnDisk:
    """Monocular maps that lie beside the pictures of a capture."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self.kind = capture, capture.mono_kind
        self.about = f"{self.kind} maps on disk" + (" (emulated)" if capture.mono_emulated else "")

    def key(self, camera: str, frame: Frame) -> str:
        """Hash of the map itself."""
        stored = self.capture.mono(camera, frame.number)
        return "none" if stored is None else digest(stored)

    def map(self, camera: str, frame: Frame) -> np.ndarray | None:
        """The stored map, enlarged to the picture."""
        stored = self.capture.mono(camera, frame.number)
        return None if stored is None else upsample(stored, *frame.images[camera].shape[:2])


class MapsFromNetwork:
    """Predictions of an ONNX network, cached at the network's output size."""

    def __init__(self, model: MonocularModel, cache: Path) -> None:
        self.model, self.kind, self.entries = model, model.kind, EntryFolder(cache)
        self.about = f"{model.kind} maps of {model.path.name} on {model.provider}, preprocessing {model.preprocessing}"
        self._fingerprint = model.fingerprint()

    def key(self, camera: str, frame: Frame) -> str:
        """Hash of network and picture."""
        return hash_of(MONO_VERSION, self._fingerprint, frame.hashes[camera])

    def map(self, camera: str, frame: Frame) -> np.ndarray:
        """The prediction, computed once."""
        key = self.key(camera, frame)
        entry = self.entries.find_current(camera, frame.number, key)
        if entry is None:
            prediction = self.model.predict(frame.images[camera])
            self.entries.write(camera, frame.number, prediction, {"key": key, "about": self.about})
        else:
            prediction = entry.array()
        return upsample(prediction, *frame.images[camera].shape[:2])


def mono_source(capture: Capture, settings: PriorSettings, cache: Path) -> MonoSource | None:
    """The monocular source that settings and capture name, or None where there is none.

    Raises:
        D2Error: a network without a declared kind, or a declared kind that contradicts the capture's.
    """
    if settings.mono_onnx:
        if settings.mono_kind is None:
            raise D2Error(
                f"what {settings.mono_onnx} predicts is not declared: say mono_kind = relative (inverse depth, as most "
                "Depth Anything V2 models) or metric"
            )
        model = MonocularModel(
            settings.mono_onnx, settings.mono_kind, settings.mono_preprocessing, settings.mono_threads
        )
        return MapsFromNetwork(model, cache)
    if capture.mono_kind is None:
        return None
    if settings.mono_kind not in (None, capture.mono_kind):
        raise D2Error(
            f"mono_kind = {settings.mono_kind} but the maps of {capture.name} are declared {capture.mono_kind}: "
            "leave mono_kind out, or correct cameras.json"
        )
    return MapsOnDisk(capture)


@dataclass(frozen=True, eq=False)
class StoredDepth:
    """D^g of one view as the cache gives it back: `depth` float32 [H, W] (0 = none) and what is recorded about it."""

    depth: np.ndarray
    record: dict[str, Any]


class GeometricSource:
    """Filtered geometric depth of all cameras, one timestamp at a time, cached as 16-bit logarithmic depth.

    Frames come in blocks within which matches of static pixels are carried over, so a frame depends on the pictures
    before it in its block and on no other. Depth that lies on disk is filtered and cached in the same way.

    Args:
        cameras: the cameras that are matched.
        bounds: depth range that is searched; None only where `recorded` is given, and then nothing is out of range.
        settings: matching, filtering, carrying over.
        cache: folder of the cache; the matches of unfinished blocks lie in `matches` beside it.
        frames: all frame numbers of the build, ascending.
        read: reads the pictures of one frame.
        recorded: depth on disk, which is taken in place of matching.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        bounds: DepthBounds | None,
        settings: StereoSettings,
        cache: Path,
        frames: Sequence[int],
        read: Callable[[int], Frame],
        recorded: RecordedDepth | None = None,
    ) -> None:
        self.maker = choose_maker(settings.maker) if recorded is None else recorded.maker
        if recorded is not None or self.maker in WHOLE_PICTURES:
            settings = replace(settings, reuse_static=False)
        self.cameras, self.bounds, self.settings, self.read = list(cameras), bounds, settings, read
        self.recorded = recorded
        self.entries, self.matches = EntryFolder(cache), cache.with_name("matches")
        self.blocks = frame_blocks(frames, settings)
        self._before = {after: before for block in self.blocks for before, after in pairwise(block)}
        self._keys: dict[int, str] = {}
        self._memory, self._remembered = MatchMemory(), ""
        self._read_maps: tuple[int | None, list[np.ndarray]] = None, []

    def key(self, frame: Frame) -> str:
        """Hash of pictures, cameras, range and settings: of all views, since each depends on all."""
        if frame.number not in self._keys:
            before = self._before.get(frame.number)
            if before is not None and before not in self._keys:
                self.key(self.read(before))
            self._keys[frame.number] = hash_of(
                STEREO_VERSION,
                self.maker,
                asdict(self.settings),
                None if self.bounds is None else list(self.bounds[:2]),
                [describe_camera(camera) for camera in self.cameras],
                [frame.hashes[camera.name] for camera in self.cameras],
                None if self.recorded is None else [digest(depth) for depth in self._maps(frame.number)],
                "" if before is None else self._keys[before],
            )
        return self._keys[frame.number]

    def depths(self, frame: Frame) -> dict[str, StoredDepth]:
        """D^g by camera name; what the cache holds already is not computed again."""
        key = self.key(frame)
        stored = {camera.name: self._stored(camera.name, frame.number, key) for camera in self.cameras}
        if any(depth is None for depth in stored.values()):
            self._store(frame, key, self._match(frame))
            stored = {camera.name: self._stored(camera.name, frame.number, key) for camera in self.cameras}
        return stored

    def _stored(self, camera: str, frame: int, key: str) -> StoredDepth | None:
        entry = self.entries.find_current(camera, frame, key)
        if entry is None:
            return None
        return StoredDepth(DepthRange(*entry.record["depth_range"]).decode(entry.array()), entry.record)

    def _maps(self, number: int) -> list[np.ndarray]:
        """The maps on disk of one frame, float32 [H, W] per camera, 0 where unknown or out of range."""
        if self._read_maps[0] != number:
            near, far = (0.0, np.inf) if self.bounds is None else self.bounds[:2]
            found = [(camera, self.recorded.depth(camera, number)) for camera in self.cameras]
            whole = [np.zeros((c.height, c.width), np.float32) if depth is None else depth for c, depth in found]
            self._read_maps = number, [np.where((d >= near) & (d <= far), d, np.float32(0)) for d in whole]
        return self._read_maps[1]

    def _match(self, frame: Frame) -> list[GeometricDepth]:
        """Match one frame after making sure that the memory is that of the frame before it."""
        if self.recorded is not None:
            images = [frame.images[camera.name] for camera in self.cameras]
            return filter_recorded(images, self.cameras, self._maps(frame.number), self.maker, self.settings)
        before = self._before.get(frame.number)
        folder = self.matches / f"{self._first(frame.number):05d}"
        if before is None:
            self._memory = MatchMemory()
        elif self._remembered != self._keys[before]:
            saved = MatchMemory.load(folder, self._keys[before], len(self.cameras))
            if saved is None:
                self._match(self.read(before))
            else:
                self._memory = saved
        images = [frame.images[camera.name] for camera in self.cameras]
        memory = self._memory if self.settings.reuse_static else None
        results = geometric_depth(images, self.cameras, self.bounds[:2], self.settings, self.maker, memory)
        self._remembered = self.key(frame)
        if frame.number in self._before.values():
            self._memory.save(folder, self._remembered)
        return results

    def _first(self, number: int) -> int:
        return next(block[0] for block in self.blocks if number in block)

    def _store(self, frame: Frame, key: str, results: Sequence[GeometricDepth]) -> None:
        matched = round(self._memory.matched_share, 6) if self.settings.reuse_static else 1.0
        for camera, result in zip(self.cameras, results):
            depth_range = DepthRange.of(result.depth)
            record = {
                "key": key,
                "maker": self.maker,
                "matched_share": matched,
                "depth_range": [depth_range.near, depth_range.far],
                "survivors": {name: int(count) for name, count in result.survivors.items()},
            }
            self.entries.write(camera.name, frame.number, depth_range.encode(result.depth), record)


def frame_blocks(frames: Sequence[int], settings: StereoSettings) -> list[tuple[int, ...]]:
    """Frames in the groups that must be built in order; single frames where nothing is carried over."""
    size = max(settings.reuse_block, 1) if settings.reuse_static else 1
    return [tuple(frames[start : start + size]) for start in range(0, len(frames), size)]


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
